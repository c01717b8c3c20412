"""Each rover is independent of the other rovers in its batch and of earlier episodes, bit for bit."""

from __future__ import annotations

import pytest
import torch
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from rover_rl import make_env
from rover_rl.envs.config import PoseConfig, Randomization
from rover_rl.envs.task import StepEvent
from rover_rl.worlds.pool import WorldPool
from tests.envs.test_sensors import Ground, RangeFinder
from tests.envs.test_world_pools import ROOMS
from tests.extras import needs_mujoco

TYPICAL, NOISY = Randomization.typical(), [RangeFinder(noise=0.1), RangeFinder(name="other", noise=0.1), Ground()]
FEATURES = [
    pytest.param({"backend": "bullet", "randomization": TYPICAL}, id="randomized in Bullet"),
    pytest.param({"backend": "warp", "randomization": TYPICAL}, id="randomized in Warp"),
    pytest.param({"backend": "mujoco", "randomization": TYPICAL}, id="randomized in MuJoCo", marks=needs_mujoco),
    pytest.param({"backend": "warp", "world_n": "inspect"}, id="uneven ground"),
    pytest.param({"backend": "warp", "physics": "planar", "world_n": WorldPool("maze:0-9", "plaza")}, id="planar"),
    pytest.param({"backend": "warp", "pose": PoseConfig("either")}, id="pose"),
    pytest.param({"backend": "warp", "world_n": "moon", "sensors": NOISY}, id="sensors"),
    pytest.param({"backend": "warp", "randomization": Randomization(scan_period=(4, 4))}, id="slow lidar"),
    pytest.param({"backend": "warp", "world_n": WorldPool(*ROOMS), "sensors": ["route"]}, id="pool of worlds"),
    pytest.param({"backend": "warp", "robot": "any:0-3", "sensors": ["route", "robot"]}, id="robots"),
]
"""Settings of environments that draw numbers, or have a memory, for each rover."""


def actions(env: EnvBase, steps: int, rows: int, seed: int = 0) -> torch.Tensor:
    """Random actions, mostly forward, each held for ten steps: ``[steps, rows, 2]``."""
    space, generator = env.action_spec.space, torch.Generator().manual_seed(seed)
    unit = torch.rand((steps + 9) // 10, rows, 2, generator=generator)
    unit = torch.stack((0.4 + 0.6 * unit[..., 0], 0.5 + (unit[..., 1] - 0.5) * 0.4), -1)
    return (space.low[0] + unit * (space.high[0] - space.low[0])).repeat_interleave(10, 0)[:steps]


def trajectory(env: EnvBase, row: int, row_actions: torch.Tensor) -> dict[str, torch.Tensor]:
    """All results of ``row`` with ``row_actions [steps, 2]``. The other rows act at random."""
    all_actions = actions(env, len(row_actions), env.batch_size[0], seed=1)
    all_actions[:, row] = row_actions
    td, records = env.reset(), []
    for action in all_actions:
        step, td = env.step_and_maybe_reset(td.set("action", action))
        records.append(step["next"][row])
    return dict(torch.stack(records).items(True, True))


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    for key in a:
        assert torch.equal(a[key], b[key]), f"{key} differs first at step {(a[key] != b[key]).nonzero()[0, 0].item()}"


def featured(num_envs: int, seed: int, settings: dict) -> EnvBase:
    defaults = {"world_n": "maze", "num_envs": num_envs, "seed": seed, "length": 24, "lidar_beams": 32}
    return make_env(**{**defaults, **settings})


@pytest.mark.parametrize("settings", FEATURES)
def test_what_is_drawn_or_remembered_for_a_rover_is_the_same_alone_and_in_a_batch(settings):
    """Over two episodes, and the beginning of the next."""
    alone, batch = featured(1, 9, settings), featured(6, 4, settings)
    row_actions = actions(alone, 52, 1)[:, 0]
    expected = trajectory(alone, 0, row_actions)
    assert_same(trajectory(batch, 5, row_actions), expected)
    # The comparison is meaningful: the rover moved, and episodes ended.
    assert expected["pose"].std(0)[:2].max() > 0.05
    assert expected["done"].any()


@pytest.mark.parametrize("settings", FEATURES)
def test_partial_resets_and_held_steps_leave_other_rovers_as_they_are(settings):
    env = featured(4, 0, settings)
    check_env_specs(env, break_when_any_done="both")
    td, keep = env.reset(), torch.tensor([True, False, True, True])
    for action in actions(env, 5, 4):
        td = env.step(td.set("action", action))["next"]
    before = td.clone()
    after = env.reset(td.set("_reset", ~keep[:, None])).exclude("_reset")
    active = torch.tensor([False, False, True, True])
    held = env.step(after.clone().set("action", torch.zeros(4, 2)).set("_step", active))["next"]
    sensed = [key for key in env.observation_spec.keys() if key != "outcome"]  # noqa: SIM118
    assert {"lidar", "pose", "imu", "target", "velocities"} <= {*sensed}
    for key in [*sensed, *([("outcome", "world")] if isinstance(settings.get("world_n"), WorldPool) else [])]:
        assert torch.equal(after[key][keep], before[key][keep]), key
        assert torch.equal(held[key][~active], after[key][~active]), key
    assert not torch.equal(after["pose"][1], before["pose"][1])
    # Rows that are held, in their episode and at its beginning, keep their counters and get no reward.
    for key in env.observation_spec["outcome"].keys():  # noqa: SIM118
        assert key == "phase" or torch.equal(held["outcome", key][~active], after["outcome", key][~active]), key
    assert held["outcome", "steps"].flatten().tolist() == [5, 0, 6, 6]
    assert torch.equal(held["outcome", "phase"].flatten() == StepEvent.NONE, ~active)
    assert not held["reward"][~active].any()
    assert not any(component[~active].any() for component in held["reward_components"].values())
    assert held["reward"][active].all()
    assert not torch.equal(held["imu"][2], after["imu"][2])
