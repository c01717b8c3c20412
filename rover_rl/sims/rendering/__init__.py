"""Rendering of a rover in its world, shared by all simulators."""
