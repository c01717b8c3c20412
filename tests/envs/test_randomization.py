"""Domain randomization: the same for every simulator, seeded, and off unless asked for."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache

import pytest
import torch

from rover_rl import RoverEnv, make_env
from rover_rl.envs.config import Randomization
from rover_rl.envs.placement import draw_dynamics
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.worlds import Terrain, World
from tests.extras import BACKENDS

RISE = math.tan(math.radians(20)) * (torch.arange(33) * 0.25 - 4)
SLOPE = World("slope", Terrain(RISE.expand(33, -1), 0.25), spawn_range=((-2, 2), (-2, 2)))


def make(rows: int, randomization: Randomization | None, backend: str = "warp"):
    settings = {"world_n": "maze", "seed": 0, "lidar_beams": 64, "backend": backend}
    return make_env(num_envs=rows, randomization=randomization, **settings).base_env


def driven(env: RoverEnv, steps: int, *action: float) -> Iterator[RoverEnv]:
    """Yields the environment after each step with an action."""
    td, command = env.reset(), torch.tensor([action]).expand(env.num_envs, 2)
    for _ in range(steps):
        td = env.step(td.set("action", command))["next"]
        yield env


@cache
def poses(backend: str, randomization: Randomization | None):
    """Poses of 15 steps on a curve, ``[steps, rows, 3]``. Each is run once for all tests."""
    return torch.stack([env.rover_state.position for env in driven(make(2, randomization, backend), 15, 0.7, 0.3)])


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    "randomization",
    [
        Randomization(friction=(0.3, 0.4)),
        Randomization(chassis_mass=(2.0, 3.0)),
        Randomization(motor_torque=(0.05, 0.1)),
        Randomization(latency=(2, 3)),
    ],
    ids=["friction", "mass", "motors", "latency"],
)
def test_each_thing_changes_how_rovers_drive(backend, randomization):
    plain, varied = poses(backend, Randomization()), poses(backend, randomization)
    assert torch.equal(plain[0, :, :2].round(decimals=1), varied[0, :, :2].round(decimals=1))
    assert ((plain - varied)[-1, :, :2].norm(dim=-1) > 1e-4).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_less_friction_makes_a_rover_slide_down_a_slope_and_more_holds_it(backend):
    moved = []
    for factor in (0.5, 1.5):
        env = RoverEnv(backend=backend, world_n=SLOPE, seed=0, randomization=Randomization(friction=(factor, factor)))
        td = env.reset(start=torch.tensor([[0.0, 0.0, 0.0]]), goal=torch.tensor([[3.0, 3.0]]))
        for _ in range(30):
            td = env.step(td.set("action", torch.zeros(1, 2)))["next"]
        moved.append(td["pose"][0, :2].norm().item())
    # tan(20 degrees) is 0.36, between half and one and a half times 0.5.
    assert moved[0] > 0.3
    assert moved[1] < 0.02


def test_factors_are_drawn_evenly_from_their_ranges_and_anew_in_each_episode():
    randomization = Randomization(friction=(0.5, 1.5), chassis_mass=(1.0, 2.0))
    keys = torch.randint(-(2**62), 2**62, (4000, 1), generator=torch.Generator().manual_seed(0))
    drawn = draw_dynamics(randomization, keys)
    for values, (low, high) in ((drawn.friction, (0.5, 1.5)), (drawn.chassis_mass, (1.0, 2.0))):
        assert low <= values.min() < low + 0.02
        assert high - 0.02 < values.max() <= high
        assert values.mean().item() == pytest.approx((low + high) / 2, abs=0.02)
    assert (drawn.motor_torque == 1.0).all()
    assert abs(torch.corrcoef(torch.stack((drawn.friction, drawn.chassis_mass)))[0, 1]) < 0.05


def test_sensors_have_the_noise_that_was_asked_for():
    def standing(randomization):
        sensed = [env.state.sensed for env in driven(make(32, randomization), 10, 0.0, 0.0)]
        return torch.stack([one.ranges for one in sensed]), torch.stack([one.rover.orientation for one in sensed])

    true_ranges, true_orientation = standing(None)
    ranges, orientation = standing(Randomization(range_noise=0.02, dropout=0.1, imu_noise=0.01))
    seen, lost = torch.isfinite(true_ranges), ~torch.isfinite(ranges)
    assert lost[seen].float().mean().item() == pytest.approx(0.1, abs=0.01)
    assert lost[~seen].all()
    error = (ranges - true_ranges)[seen & ~lost]
    assert error.std().item() == pytest.approx(0.02, rel=0.1)
    assert error.mean().abs().item() < 0.001
    # The angle between two orientations, of three axes that are off by 0.01 rad each.
    turned = 2 * torch.acos((orientation * true_orientation).sum(-1).abs().clamp(max=1.0).double())
    assert turned.square().mean().sqrt().item() == pytest.approx(0.01 * math.sqrt(3), rel=0.1)
    # In each step anew.
    assert not torch.equal(orientation[0], orientation[1])


def test_wheel_odometry_is_as_noisy_and_commands_come_as_late_as_was_asked_for():
    env = make(32, Randomization(odometry_noise=0.05))
    speeds = [each.state.sensed.rover.linear_velocity for each in driven(env, 20, 0.3, 0.0)]
    assert (torch.stack(speeds[10:]) / 0.3).std().item() == pytest.approx(0.05, rel=0.2)
    late = make(2, Randomization(latency=(2, 2)))
    moved = [each.rover_state.linear_velocity.abs().max().item() > 0.01 for each in driven(late, 5, 1.0, 0.0)]
    assert moved == [False, False, True, True, True]


def test_a_live_rover_is_what_it_is():
    live = {"connection_check_timeout": 0, "backend": Ros2Settings(reset="none")}
    with pytest.raises(ValueError, match="friction, mass and motors need a backend in which they can be varied"):
        RoverEnv(randomization=Randomization(friction=(0.5, 1.5)), **live)
