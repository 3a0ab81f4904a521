"""Pictures of results, and reports on whole sweeps."""
