"""What can go wrong with a live rover."""

from __future__ import annotations


class RobotLostError(ConnectionError):
    """A live rover no longer says where it is or what it sees. It was told to stop."""


class PoseResetError(OSError):
    """A live rover could not be put where the episode starts."""
