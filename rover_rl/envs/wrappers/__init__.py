"""Gymnasium and Stable-Baselines3 interfaces of the environment."""
