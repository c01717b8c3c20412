"""Each rover is independent of the other rovers in its batch and of earlier episodes, bit for bit."""

from __future__ import annotations

import pytest
import torch

from rover_rl import make_env
from tests.extras import needs_mujoco

OBSERVED = ("lidar", "pose", "imu", "target", "velocities", "reward", "done", "terminated", "truncated")


def actions(steps: int, rows: int, low: torch.Tensor, high: torch.Tensor, seed: int = 0) -> torch.Tensor:
    """Random actions, mostly forward, each held for ten steps: ``[steps, rows, 2]``."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand((steps + 9) // 10, rows, 2, generator=generator)
    unit[..., 0] = 0.4 + 0.6 * unit[..., 0]
    unit[..., 1] = 0.5 + (unit[..., 1] - 0.5) * 0.4
    return (low + unit * (high - low)).repeat_interleave(10, 0)[:steps]


def trajectory(env, steps: int, row: int, row_actions: torch.Tensor) -> dict[str, torch.Tensor]:
    """Results of ``row`` over ``steps`` steps with ``row_actions [steps, 2]``. The other rows act at random."""
    spec = env.action_spec.space
    all_actions = actions(steps, env.batch_size[0], spec.low[0], spec.high[0], seed=1)
    all_actions[:, row] = row_actions
    td, records = env.reset(), []
    for action in all_actions:
        step, td = env.step_and_maybe_reset(td.set("action", action))
        records.append({key: step["next", key][row] for key in OBSERVED})
    return {key: torch.stack([record[key] for record in records]) for key in OBSERVED}


def actions_of_one_row(env, steps: int) -> torch.Tensor:
    spec = env.action_spec.space
    return actions(steps, 1, spec.low[0], spec.high[0])[:, 0]


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    for key in OBSERVED:
        assert torch.equal(a[key], b[key]), f"{key} differs first at step {(a[key] != b[key]).nonzero()[0, 0].item()}"


SEED = 240
"""Seed of the rover that is compared. Row k of a batch with the seed s is the single rover with the seed s + k."""
SETTINGS = {"lidar_beams": 32, "length": 100}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "world", "batches"),
    [
        # Over two episodes and the beginning of a third in a small batch, else over one and the beginning of the next:
        # in Bullet and in MuJoCo, the steps of a large batch take long.
        ("bullet", "maze", [(6, 5, 210), (64, 50, 110)]),
        ("bullet", "moon", [(6, 5, 110)]),
        ("bullet", "inspect", [(6, 0, 110)]),
        ("warp", "maze", [(256, 200, 110)]),
        ("warp", "moon", [(16, 15, 150)]),
        ("warp", "inspect", [(33, 0, 150)]),
        pytest.param("mujoco", "maze", [(6, 5, 210)], marks=needs_mujoco),
        pytest.param("mujoco", "moon", [(16, 15, 110)], marks=needs_mujoco),
    ],
)
def test_a_rover_is_the_same_alone_and_in_a_batch(backend, world, batches):
    """Each batch is a number of rovers, the row of the compared rover and the number of compared steps."""
    single = make_env(backend=backend, world_n=world, num_envs=1, seed=SEED, **SETTINGS)
    row_actions = actions_of_one_row(single, max(steps for _, _, steps in batches))
    alone = trajectory(single, len(row_actions), 0, row_actions)
    for num_envs, row, steps in batches:
        batch = make_env(backend=backend, world_n=world, num_envs=num_envs, seed=SEED - row, **SETTINGS)
        expected = {key: values[:steps] for key, values in alone.items()}
        assert_same(trajectory(batch, steps, row, row_actions[:steps]), expected)
        # The comparison is meaningful: the rover moved, and episodes ended.
        assert expected["pose"].std(0)[:2].max() > 0.05
        assert expected["done"].any()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["bullet", "warp", pytest.param("mujoco", marks=needs_mujoco)])
@pytest.mark.parametrize("world", ["maze", "inspect"])
def test_a_rover_is_the_same_after_fifty_resets_of_itself_and_others(world, backend):
    env = make_env(backend=backend, world_n=world, num_envs=4, seed=3, lidar_beams=32, length=60)
    row_actions = actions_of_one_row(env, 80)
    expected = trajectory(env, 80, 2, row_actions)
    td = env.reset()
    for k in range(50):
        reset = torch.zeros(4, 1, dtype=torch.bool)
        reset[k % 4] = reset[2] = True
        td = env.reset(td.set("_reset", reset))
        td = env.step(td.set("action", env.action_spec.rand()))["next"]
    env.set_seed(3)
    assert_same(trajectory(env, 80, 2, row_actions), expected)
