"""TorchRL transforms for training: action repeat, path reward and timing."""
