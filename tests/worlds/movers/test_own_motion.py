"""Motions from outside the package."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from rover_rl.rng import to_unit
from rover_rl.worlds.movers import Courses, Cylinder, Motion, Mover, Scene, SocialForce
from tests.worlds.movers.crowds import DT, begun, walk, yard


@dataclass(frozen=True)
class Circle(Motion):
    """Goes around a point, from a random place on."""

    x: float = 0.0
    y: float = 0.0
    radius: float = 2.0
    speed: float = 1.0

    @classmethod
    def begin(cls, scene: Scene) -> Courses:
        # The clock keeps the angle at which the episode begins.
        return cls.at(scene, 2 * math.pi * to_unit(scene.bits(1)[..., 0]))

    @classmethod
    def advance(cls, scene: Scene) -> Courses:
        return cls.at(scene, scene.course.clock)

    @classmethod
    def at(cls, scene: Scene, first: Tensor) -> Courses:
        x, y, radius, speed = (scene.settings[name] for name in ("x", "y", "radius", "speed"))
        angle = first + scene.time * speed / radius
        out = torch.stack((angle.cos(), angle.sin()), -1)
        ahead = torch.stack((-out[..., 1], out[..., 0]), -1)
        return replace(
            scene.course,
            position=torch.stack((x, y), -1) + radius[..., None] * out,
            yaw=angle + math.pi / 2,
            velocity=speed[..., None] * ahead,
            clock=first,
        )


def test_an_own_motion_moves_beside_those_of_the_package() -> None:
    movers = [Mover(Circle(1.0, 2.0, 3.0, 0.5)), Mover(SocialForce(), Cylinder(0.3))]
    field = begun([yard(movers), yard(movers[1:])], rovers=torch.full((2, 2), 8.0))
    points = walk(field, 100)[:, 0, 0]
    assert (points - torch.tensor([1.0, 2.0])).norm(dim=-1).tolist() == pytest.approx([3.0] * 100, abs=1e-4)
    assert (points.diff(dim=0).norm(dim=-1) / DT).mean() == pytest.approx(0.5, rel=1e-3)
    # Whatever types it returns.
    assert field.course.position.dtype == field.course.yaw.dtype == torch.float32


def test_it_draws_its_own_random_numbers_for_each_row_and_mover() -> None:
    world = yard([Mover(Circle()), Mover(Circle())])
    field = begun([world] * 4)
    assert len(field.course.clock.unique()) == 8
    assert torch.equal(begun([world], seed=2).course.clock[0], field.course.clock[2])
