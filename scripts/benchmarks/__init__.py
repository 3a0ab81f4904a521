"""The parts of `scripts/benchmark.py`, one module each, written on the public API of trackmdp."""
