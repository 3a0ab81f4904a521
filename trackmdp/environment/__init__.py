"""The tracking environment of TorchRL and of Gymnasium."""
