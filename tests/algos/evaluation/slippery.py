"""A backend of a package's user: Bullet on ground with hardly any friction, where rovers reach near goals only."""

from __future__ import annotations

from dataclasses import dataclass

from rover_rl.sims import Simulator, make_simulator
from rover_rl.sims.bullet import BulletSettings


@dataclass(frozen=True)
class Slippery:
    friction: float = 0.01

    def make(self, *, worlds, robot, connection=None, device=None) -> Simulator:
        settings = BulletSettings(ground_friction=self.friction)
        return make_simulator(settings, worlds=worlds, robot=robot)


class NotInstalled:
    def make(self, **arguments) -> Simulator:
        raise ImportError("this backend needs a library: pip install library")
