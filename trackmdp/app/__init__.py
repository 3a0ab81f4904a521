"""The command line: composing, checking, launching and sweeping commands with Hydra."""
