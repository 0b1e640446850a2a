"""The environment for TorchRL and for Gymnasium."""
