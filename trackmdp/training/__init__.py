"""From an algorithm to a run: collecting, judging, logging, saving."""
