"""The motion of targets: kernels, hidden modes, and the chain of hidden states."""
