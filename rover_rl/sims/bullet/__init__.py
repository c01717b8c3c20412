"""Bullet backend: rigid-body physics in PyBullet, lidar with ``rayTestBatch``."""

from __future__ import annotations

from rover_rl.sims.bullet.settings import BulletSettings
from rover_rl.sims.bullet.simulator import BulletSimulator

__all__ = ["BulletSettings", "BulletSimulator"]
