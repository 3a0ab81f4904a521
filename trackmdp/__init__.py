"""Target tracking with controlled sensing: learn it, solve it, study it (Track-MDP)."""

__version__ = "0.1.0"
