"""Lidars that see in part: views and dead sectors of an episode, and the mask of what beams cover."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict

from rover_rl import LidarConfig, Randomization, RoverEnv
from rover_rl.envs.sensors.standard import LidarMask, hidden_beams

SECTORS = {"dead_sectors": 2, "dead_sector_width": (0.2, 0.5)}
PARTIAL = Randomization(lidar_view=(math.pi, 2 * math.pi), lidar_min_range=(0.4, 0.8), **SECTORS)
LIDAR = LidarConfig(points=64, beams=64)


def episodes(rows: int, seed: int = 3, randomization: Randomization = PARTIAL) -> tuple[RoverEnv, list[TensorDict]]:
    """First observations of two episodes, and one after a step, for which the first row alone is reset."""
    env = RoverEnv(world="maze", num_envs=rows, seed=seed, backend="warp", lidar=LIDAR, randomization=randomization)
    seen = [env.reset(), env.reset()]
    td = env.step(seen[-1].clone().set("action", torch.zeros(rows, 2)))["next"]
    begins = torch.arange(rows)[:, None] == 0
    return env, [*seen, env.reset(td.set("_reset", begins))]


def test_hidden_readings_have_no_return_and_the_mask_that_each_episode_draws_says_so() -> None:
    env, partial = episodes(6)
    _, full = episodes(6, randomization=Randomization())
    assert "lidar_mask" not in full[0].keys()  # noqa: SIM118
    for seen, all_of_it in zip(partial, full, strict=True):
        hidden = seen["lidar_mask"] == 0
        assert hidden.any(-1).all()
        assert (seen["lidar"][hidden] == 12.0).all()
        assert torch.equal(seen["lidar"][~hidden], all_of_it["lidar"][~hidden])
        assert (seen["lidar_mask"][~hidden] == 1).all(), "a reading of one beam is covered, or it is not"
    # What happens in a hidden direction happens all the same.
    assert (env.scan[partial[-1]["lidar_mask"] == 0] < 12.0).any()
    masks = [seen["lidar_mask"] for seen in partial]
    assert not torch.equal(masks[0], masks[1])
    assert torch.equal(masks[1][1:], masks[2][1:]), "rows that are not reset keep it"
    assert not torch.equal(masks[1][0], masks[2][0])
    for seen, alone in zip(masks[:2], episodes(1, seed=5)[1], strict=False):
        assert torch.equal(seen[2:3], alone["lidar_mask"])


def test_views_and_sectors_are_drawn_from_their_ranges() -> None:
    keys = torch.randint(-(2**62), 2**62, (2000, 1), generator=torch.Generator().manual_seed(0))
    ranges = torch.linspace(0.01, 1.0, 360).expand(2000, 360)
    hidden = hidden_beams(Randomization(lidar_view=(2.0, 4.0)), keys, ranges)
    angles = (~hidden).sum(-1) * math.radians(1)
    assert 1.97 < angles.min() < 2.03
    assert 3.97 < angles.max() < 4.03
    assert angles.mean().item() == pytest.approx(3.0, abs=0.03)
    assert torch.equal(hidden[:, 1:], hidden[:, 1:].flip(-1)), "a view is centered on straight ahead"
    hidden = hidden_beams(Randomization(dead_sectors=2, dead_sector_width=(0.2, 0.2)), keys, ranges)
    edges = (hidden & ~hidden.roll(1, -1)).sum(-1)
    # A third of the episodes has none, and of those with two, some overlap.
    shares = [(edges == count).float().mean().item() for count in range(3)]
    assert shares == pytest.approx([1 / 3, 1 / 3, 1 / 3], abs=0.05)
    assert (hidden.sum(-1)[edges == 1] >= 11).all()
    assert hidden.float().mean(0).std() < 0.02, "they are in any direction"
    hidden = hidden_beams(Randomization(lidar_min_range=(0.1, 0.3)), keys, ranges)
    nearest = ranges.masked_fill(hidden, math.inf).amin(-1)
    assert torch.equal(hidden, ranges < nearest[:, None])
    ends = nearest.min().item(), nearest.mean().item(), nearest.max().item()
    assert ends == pytest.approx((0.1, 0.2, 0.3), abs=5e-3)


def test_the_mask_is_that_of_the_view_of_the_robot_and_its_mirror_image_is_mirrored() -> None:
    env = RoverEnv(num_envs=1, seed=0, robot="jackal", backend="warp", sensors=["lidar_mask"])
    td = env.reset()
    # 135 degrees to each side: 12 readings of 11.25 degrees, of which the last one on the right begins a beam later.
    expected = torch.tensor([[1.0] * 12 + [0.25] + [0.0] * 7 + [1.0] * 12])
    assert torch.equal(td["lidar_mask"], expected)
    sensor = env.sensors["lidar_mask"]
    assert torch.equal(sensor.mirror(td["lidar_mask"]), expected.flip(-1))
    assert sensor.encode(td["lidar_mask"]).unique().tolist() == [-1.0, -0.5, 1.0]
    assert LidarMask(points=16).features == 16
