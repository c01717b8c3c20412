"""On the GPU, a row does not depend on its company or on the size of the batch, to the last bit."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import Randomization
from rover_rl.envs.seen_map.seen_map import SeenMap
from rover_rl.robots import get_robot
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.warp import WarpSettings
from tests.gpu.driven import ROUGH, drive, environment

STEPS = 40
SEED = 7


def assert_same(some: list[TensorDictBase], others: list[TensorDictBase], rows: slice, other_rows: slice) -> None:
    """Checks that all entries of rows are the same in each step, to the last bit."""
    for step, (a, b) in enumerate(zip(some, others, strict=True)):
        a, b = a[rows], b[other_rows]
        assert set(a.keys(True, True)) == set(b.keys(True, True))
        for key in a.keys(True, True):
            assert torch.equal(a[key], b[key]), (step, key)


@pytest.mark.parametrize("settings", [{"world_n": "moon"}, {"randomization": Randomization.typical()}])
def test_a_run_repeats_itself(gpu: torch.device, settings: dict[str, Any]) -> None:
    first, again = (drive(environment(gpu, 64, **settings), STEPS) for _ in range(2))
    assert_same(first, again, slice(None), slice(None))


def test_a_row_does_not_depend_on_the_size_of_the_batch(gpu: torch.device) -> None:
    # The actions of drive() repeat every 20 rows: row 40 of the one batch acts as row 0 of the other.
    many = drive(environment(gpu, 300, world_n="moon", seed=SEED), STEPS)
    few = drive(environment(gpu, 7, world_n="moon", seed=SEED + 40), STEPS)
    assert_same(many, few, slice(40, 47), slice(7))


def test_scans_do_not_depend_on_the_number_of_threads(gpu: torch.device) -> None:
    scans = []
    for lanes in (2, 8, 32):
        env = environment(gpu, 192, world_n=ROUGH, backend=WarpSettings(lidar_lanes=lanes))
        env.reset()
        scans.append(env.base_env.scan.cpu())
        env.close()
    assert all(torch.equal(scan, scans[0]) for scan in scans[1:])


def test_a_map_does_not_depend_on_the_size_of_the_batch(gpu: torch.device) -> None:
    env = environment(gpu, 96, lidar_points=128, length=200)
    lidar = env.base_env.config.lidar
    many, few = (SeenMap(Fleet.of(get_robot("rover_zero"), rows, gpu), lidar) for rows in (96, 5))
    for step in drive(env, 40)[::4]:
        observation = step.to(gpu)
        assert torch.equal(many(observation)[50:55], few(observation[50:55]))
