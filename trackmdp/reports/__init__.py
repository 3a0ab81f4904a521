"""What is made of results: pictures, and reports on whole sweeps."""
