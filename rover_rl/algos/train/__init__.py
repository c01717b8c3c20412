"""Training: PPO, SAC, and what they share."""
