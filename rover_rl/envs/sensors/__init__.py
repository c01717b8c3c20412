"""Sensors: the entries of an observation. ``base`` says what a sensor is, and ``suite`` lists them by name."""
