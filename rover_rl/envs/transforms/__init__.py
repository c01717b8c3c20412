"""TorchRL transforms for training: action repeat, a path reward, timing."""
