"""Training on TorchRL, evaluation and plots."""
