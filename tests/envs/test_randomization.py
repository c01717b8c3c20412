"""Domain randomization: the same for every simulator, seeded, and off unless asked for."""

from __future__ import annotations

import math
from functools import cache

import pytest
import torch

from rover_rl import RoverEnv, make_env
from rover_rl.envs.config import Randomization
from rover_rl.envs.placement import draw_dynamics
from rover_rl.sims.ros2 import Ros2Settings
from rover_rl.sims.rover_state import Dynamics
from rover_rl.worlds import Terrain, World
from tests.extras import BACKENDS

RISE = math.tan(math.radians(20)) * (torch.arange(33) * 0.25 - 4)
SLOPE = World("slope", Terrain(RISE.expand(33, -1), 0.25), spawn_range=((-2, 2), (-2, 2)))


@cache
def rolled(backend: str, randomization: Randomization | None, rows: int = 4, steps: int = 40):
    """Results of a rollout, ``[rows, steps]``. Each is run once for all tests."""
    env = make_env(
        backend=backend, world_n="maze", num_envs=rows, seed=0, length=25, randomization=randomization, lidar_beams=64
    )
    generator = torch.Generator().manual_seed(0)
    own = torch.rand(steps, 1, 2, generator=generator) * torch.tensor((0.6, 0.6)) + torch.tensor((0.4, -0.3))
    td, seen = env.reset(), []
    for action in own:
        step, td = env.step_and_maybe_reset(td.set("action", action.expand(rows, 2)))
        seen.append(step["next"])
    env.close()
    return torch.stack(seen, 1)


@pytest.mark.parametrize("backend", BACKENDS)
def test_by_itself_nothing_varies(backend):
    assert (rolled(backend, None) == rolled(backend, Randomization())).all()


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
    plain, varied = rolled(backend, None), rolled(backend, randomization)
    assert torch.equal(plain["pose"][:, 0, :2].round(decimals=1), varied["pose"][:, 0, :2].round(decimals=1))
    # It ends elsewhere within the first episode.
    assert ((plain["pose"] - varied["pose"])[:, 20, :2].norm(dim=-1) > 1e-4).all()


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
    env = RoverEnv(world_n="maze", num_envs=1, seed=0)
    randomization = Randomization(friction=(0.5, 1.5), chassis_mass=(1.0, 2.0))
    keys = torch.randint(-(2**62), 2**62, (4000, 1), generator=torch.Generator().manual_seed(0))
    drawn = draw_dynamics(randomization, keys)
    assert isinstance(drawn, Dynamics)
    for values, (low, high) in ((drawn.friction, (0.5, 1.5)), (drawn.chassis_mass, (1.0, 2.0))):
        assert low <= values.min() < low + 0.02
        assert high - 0.02 < values.max() <= high
        assert values.mean().item() == pytest.approx((low + high) / 2, abs=0.02)
    assert (drawn.motor_torque == 1.0).all()
    assert abs(torch.corrcoef(torch.stack((drawn.friction, drawn.chassis_mass)))[0, 1]) < 0.05
    env.close()


def test_sensors_have_the_noise_that_was_asked_for():
    def standing(randomization):
        env = RoverEnv(backend="warp", world_n="maze", num_envs=32, seed=0, lidar_beams=64, randomization=randomization)
        action = torch.zeros(32, 2)
        td = env.reset()
        states = []
        for _ in range(10):
            td = env.step(td.set("action", action))["next"]
            states.append((env.state.sensed.ranges, env.state.sensed.rover.orientation))
        return tuple(torch.stack(column) for column in zip(*states, strict=True))

    true_ranges, true_orientation = standing(None)
    ranges, orientation = standing(Randomization(range_noise=0.02, dropout=0.1, imu_noise=0.01))
    seen = torch.isfinite(true_ranges)
    lost = ~torch.isfinite(ranges)
    assert lost[seen].float().mean().item() == pytest.approx(0.1, abs=0.01)
    assert lost[~seen].all()
    both = seen & ~lost
    assert (ranges - true_ranges)[both].std().item() == pytest.approx(0.02, rel=0.1)
    assert (ranges - true_ranges)[both].mean().abs().item() < 0.001
    # The angle between two orientations, of three axes that are off by 0.01 rad each.
    turned = 2 * torch.acos((orientation * true_orientation).sum(-1).abs().clamp(max=1.0).double())
    assert turned.square().mean().sqrt().item() == pytest.approx(0.01 * math.sqrt(3), rel=0.1)
    # In each step anew.
    assert not torch.equal(orientation[0], orientation[1])


def test_wheel_odometry_has_the_noise_that_was_asked_for():
    noise = Randomization(odometry_noise=0.05)
    env = RoverEnv(backend="warp", world_n="maze", num_envs=32, seed=0, lidar_beams=32, randomization=noise)
    td = env.reset()
    speeds = []
    for step in range(25):
        td = env.step(td.set("action", torch.tensor([[0.3, 0.0]] * 32)))["next"]
        if step >= 10:
            speeds.append(env.state.sensed.rover.linear_velocity)
    assert (torch.stack(speeds) / 0.3).std().item() == pytest.approx(0.05, rel=0.2)


def test_commands_come_as_late_as_was_asked_for():
    env = RoverEnv(world_n="maze", num_envs=3, seed=0, lidar_beams=32, randomization=Randomization(latency=(2, 2)))
    td = env.reset()
    moved = []
    for _ in range(5):
        td = env.step(td.set("action", torch.tensor([[1.0, 0.0]] * 3)))["next"]
        moved.append(env.rover_state.linear_velocity.abs().max().item() > 0.01)
    assert moved == [False, False, True, True, True]


def test_a_live_rover_is_what_it_is():
    with pytest.raises(ValueError, match="friction, mass and motors need a backend in which they can be varied"):
        RoverEnv(
            connection_check_timeout=0,
            backend=Ros2Settings(reset="none"),
            randomization=Randomization(friction=(0.5, 1.5)),
        )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"friction": (1.5, 0.5)}, "friction must be a range .* of positive factors"),
        ({"chassis_mass": (0.0, 1.0)}, "chassis_mass must be a range .* of positive factors"),
        ({"motor_torque": (1.0, math.inf)}, "motor_torque must be a range .* of positive factors"),
        ({"latency": (-1, 2)}, "latency must be a range .* of control steps"),
        ({"latency": (0.5, 1.5)}, "latency must be two whole numbers"),
        ({"range_noise": -0.1}, "range_noise must be at least 0 and at most 1e.30, got -0.1"),
        ({"imu_noise": math.nan}, "imu_noise must be at least 0 and at most 1e.30, got nan"),
        ({"dropout": 1.0}, "dropout must be at least 0 and less than 1, got 1.0"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Randomization(**settings)
