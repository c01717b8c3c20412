"""Sliders and doors."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from rover_rl.worlds.movers import Box, Door, Mover, Slider
from tests.worlds.movers.crowds import DT, begun, walk, yard


def test_a_slider_goes_to_and_fro_at_its_speed_and_rests() -> None:
    motion = Slider(to=(3.0, 2.0), start=(0.0, 2.0), speed=1.5, pause=1.0)
    field = begun([yard([Mover(motion)])])
    assert field.course.position[0, 0].tolist() == [0.0, 2.0]
    points = walk(field, 120)[:, 0, 0]
    # 2 s there, 1 s of rest, 2 s back, 1 s of rest.
    for time, x in ((1.0, 1.5), (2.0, 3.0), (3.0, 3.0), (4.0, 1.5), (5.0, 0.0), (6.0, 0.0)):
        assert points[round(time / DT) - 1].tolist() == pytest.approx([x, 2.0], abs=1e-5)


def test_a_period_takes_the_place_of_the_speed() -> None:
    points = walk(begun([yard([Mover(Slider(to=(0.0, 4.0), period=10.0, pause=1.0))])]), 200)[:, 0, 0, 1]
    assert points[79] == pytest.approx(4.0, abs=1e-5)
    assert points[99] == pytest.approx(4.0, abs=1e-5)
    assert points[179] == pytest.approx(0.0, abs=1e-5)


def test_a_smooth_slider_does_not_jerk() -> None:
    field = begun([yard([Mover(Slider(to=(3.0, 0.0), speed=1.0, smooth=True))])])
    points = walk(field, 240)[:, 0, 0, 0]
    speeds = points.diff() / DT
    assert speeds.max() == pytest.approx(1.5, abs=0.01)
    assert speeds.diff().abs().max() / DT < 6 * 3.0 / 3.0**2 + 0.05
    field = begun([yard([Mover(Slider(to=(3.0, 0.0), speed=1.0, smooth=True))])])
    velocity = walk(field, 60, keep="velocity")[:, 0, 0, 0]
    assert velocity[:-1].tolist() == pytest.approx(points[:61].diff()[:59].div(DT).tolist(), abs=0.06)


def test_random_phases_are_uniform() -> None:
    field = begun([yard([Mover(Slider(to=(1.0, 0.0), phase=None))] * 8)] * 100)
    x = field.course.position[..., 0]
    assert x.mean() == pytest.approx(0.5, abs=0.05)
    assert x.std() == pytest.approx(1 / math.sqrt(12), abs=0.03)


def test_a_slider_keeps_its_heading() -> None:
    motions = [Slider(to=(0.0, 2.0)), Slider(to=(0.0, 2.0), yaw=0.5)]
    yaws = walk(begun([yard([Mover(motion) for motion in motions])]), 100, keep="yaw")[:, 0]
    assert torch.equal(yaws, yaws[:1].expand_as(yaws))
    assert yaws[0].tolist() == pytest.approx([math.pi / 2, 0.5])


def test_the_edge_of_a_door_stays_at_the_hinge() -> None:
    motion = Door(hinge=(1.0, 2.0), width=0.8, closed=0.3, opening=-1.5, period=4.0, pause=0.5)
    field = begun([yard([Mover(motion, Box(0.8, 0.05, 2.0))])])
    angles = []
    for _ in range(80):
        walk(field, 1)
        yaw = field.course.yaw[0, 0]
        edge = field.course.position[0, 0] - 0.4 * torch.stack((yaw.cos(), yaw.sin()))
        assert edge.tolist() == pytest.approx([1.0, 2.0], abs=1e-5)
        assert field.parts is not None
        speed = field.parts.velocity[0, 0].norm().item()
        assert speed == pytest.approx(0.4 * field.parts.turn[0, 0].abs().item(), abs=2e-3)
        angles.append(yaw.item())
    assert angles[29] == pytest.approx(-1.2, abs=1e-5)
    assert angles[39] == pytest.approx(-1.2, abs=1e-5)
    assert angles[-1] == pytest.approx(0.3, abs=1e-5)


@pytest.mark.parametrize(
    ("motion", "arguments", "message"),
    [
        (Slider, {"to": (math.nan, 0.0)}, "to must be a point"),
        (Slider, {"to": 3.0}, "to must be a point"),
        (Slider, {"to": (0.0, 0.0)}, "to and start must be different"),
        (Slider, {"to": (1.0, 0.0), "speed": -1.0}, "speed must be positive"),
        (Slider, {"to": (1.0, 0.0), "period": 0.0}, "period must be positive"),
        (Slider, {"to": (1.0, 0.0), "period": 2.0, "pause": 1.0}, "period must be longer than two pauses of 1 s"),
        (Slider, {"to": (1.0, 0.0), "phase": 1.0}, "phase must be at least 0 and less than 1"),
        (Slider, {"to": (1.0, 0.0), "yaw": math.inf}, "yaw must be finite"),
        (Door, {"hinge": (0.0, math.nan)}, "hinge must be a point"),
        (Door, {"hinge": (0.0, 0.0), "width": 0.0}, "width must be positive"),
        (Door, {"hinge": (0.0, 0.0), "opening": 0.0}, "opening must not be 0"),
        (Door, {"hinge": (0.0, 0.0), "opening": math.nan}, "opening must be at least"),
        (Door, {"hinge": (0.0, 0.0), "period": 0.0}, "period must be positive"),
        (Door, {"hinge": (0.0, 0.0), "period": 4.0, "pause": 2.0}, "period must be longer than two pauses"),
        (Door, {"hinge": (0.0, 0.0), "phase": -0.5}, "phase must be at least 0"),
    ],
)
def test_wrong_settings_are_told_in_a_sentence(motion: type, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        motion(**arguments)
