"""The environment through the interfaces of Gymnasium and Stable-Baselines3."""
