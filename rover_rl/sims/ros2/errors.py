"""Errors of a live rover."""

from __future__ import annotations


class RobotLostError(ConnectionError):
    """A live rover no longer sends usable sensor data. A stop command was sent."""


class PoseResetError(OSError):
    """A live rover could not be moved to the start pose of an episode."""
