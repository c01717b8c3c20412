"""Drives: how commands move the joints of a robot, and how its joints tell how it moves.

- ``base``: ``Drive``, what a drive is, and ``Wheels``, the geometry that it drives.
- ``skid_steer``, ``ackermann``, ``mecanum``: a drive each.
- ``simulated``: the drives of a batch of simulated rovers.
"""

from __future__ import annotations

from rover_rl.robots.drives.ackermann import Ackermann
from rover_rl.robots.drives.base import Drive, Joints, Wheels
from rover_rl.robots.drives.mecanum import Mecanum
from rover_rl.robots.drives.skid_steer import SkidSteer

__all__ = ["Ackermann", "Drive", "Joints", "Mecanum", "SkidSteer", "Wheels"]
