"""Bullet backend: rigid-body physics in PyBullet, lidar with ``rayTestBatch``.

Importing this module does not require PyBullet; building a simulator does.
"""

from __future__ import annotations

from rover_rl.sims.bullet.settings import BulletSettings

__all__ = ["BulletSettings"]
