"""From an algorithm to a run: collecting, evaluating, logging, saving."""
