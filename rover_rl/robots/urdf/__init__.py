"""Any URDF of a wheeled robot as a robot.

- ``placed``: links of a URDF in a common frame, and their shapes.
- ``wheels``: finds the wheels; ``layout`` decides by them which drive the robot has.
- ``body``: mass and boxes of the body; ``motion``: the drive and its limits; ``mounts``: places of the sensors.
- ``derived``: writes the URDF that simulators load.
- ``read``: reads a file with all of these.
"""

from __future__ import annotations

from rover_rl.robots.urdf.read import ReadRobot, read_urdf

__all__ = ["ReadRobot", "read_urdf"]
