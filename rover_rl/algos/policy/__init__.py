"""Policies: networks, baselines, the privileged expert and checkpoints."""
