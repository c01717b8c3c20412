"""Settings and presets of the simulators."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from rover_rl import RoverEnv, Terrain, World, make_env
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.bullet.settings import PRESETS
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.warp import WarpSettings
from tests.sims.driven import drive, placed

EVERY = (BulletSettings, WarpSettings, MujocoSettings)


@pytest.mark.parametrize(
    ("kinds", "settings", "message"),
    [
        (EVERY, {"substeps": 0}, "substeps must be at least 1, got 0"),
        (EVERY, {"solver_iterations": 0}, "solver_iterations must be at least 1, got 0"),
        (EVERY, {"control_dt": 0.0}, "control_dt must be positive, got 0.0"),
        (EVERY, {"ground_friction": -0.1}, "ground_friction must not be negative, got -0.1"),
        ((BulletSettings,), {"ground_friction": math.nan}, "ground_friction must not be negative, got nan"),
        ((BulletSettings,), {"substeps": 5}, "substeps must be an even number of at least 2, got 5"),
        ((BulletSettings,), {"solver_residual": -1.0}, "solver_residual must not be negative, got -1.0"),
        ((WarpSettings, MujocoSettings), {"threads": 0}, "threads must be at least 1, got 0"),
        ((WarpSettings,), {"lidar_lanes": 3}, "lidar_lanes must be 1, 2, 4, 8, 16 or 32, got 3"),
        ((WarpSettings,), {"block_size": 48}, "block_size must be a multiple of 32 from 32 to 1024, got 48"),
        ((WarpSettings,), {"stiffness": 0.0}, "stiffness must be positive, got 0.0"),
        ((MujocoSettings,), {"stiffness": math.nan}, "stiffness must be positive, got nan"),
        ((MujocoSettings,), {"solver_tolerance": -1.0}, "solver_tolerance must not be negative, got -1.0"),
    ],
)
def test_settings_out_of_range_raise(kinds: tuple[type, ...], settings: dict[str, float], message: str) -> None:
    for kind in kinds:
        with pytest.raises(ValueError, match=message):
            kind(**settings)


@pytest.mark.parametrize(
    ("backend", "message"),
    [
        ("bullet", r"unknown physics 'exact'; use one of \['default', 'accurate', 'fast'\]"),
        ("mujoco", r"unknown physics 'exact'; use one of \['default'\]"),
        ("warp", "unknown physics 'exact'; backend 'warp' has one preset, 'default'"),
        ("ros2", "backend 'ros2' has no presets"),
        (BulletSettings(), "settings of its own"),
    ],
)
def test_unknown_presets_raise_with_the_allowed_names(backend: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RoverEnv(backend=backend, physics="exact")


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_is_selected_by_name_and_has_a_control_rate_of_20_hz(name: str) -> None:
    env = make_env(world_n="maze", num_envs=2, physics=name)
    settings = env.base_env.simulator.settings
    assert settings == PRESETS[name]
    assert settings.control_dt == settings.substep * settings.substeps == 0.05
    env.rollout(3)
    env.close()


def test_default_settings_are_the_default_preset() -> None:
    assert RoverEnv(world_n="maze").simulator.settings == PRESETS["default"] == BulletSettings()
    assert RoverEnv(backend="warp", physics="default").simulator.settings == WarpSettings()


@pytest.mark.slow
def test_accurate_has_a_smaller_error_than_fast() -> None:
    x = torch.arange(81) * 0.25 - 10
    world = World("slope", Terrain((0.15 * x).expand(81, -1), 0.25))
    random = torch.Generator().manual_seed(0)
    starts = torch.rand(12, 3, generator=random) * torch.tensor((8, 8, 2 * math.pi)) - torch.tensor((4, 4, 0))
    commands = torch.rand(12, 2, generator=random) * torch.tensor((1.6, 3.0)) - torch.tensor((0.6, 1.5))
    settings = {"reference": BulletSettings(substeps=50), **PRESETS}
    ends = {name: drive(placed(each, world, starts), commands, 40)[-1].position for name, each in settings.items()}
    errors = {name: (end - ends["reference"]).norm(dim=-1).median() for name, end in ends.items()}
    assert errors["accurate"] < errors["fast"]
