"""Settings and presets of the simulators."""

from __future__ import annotations

import math
import sys
from typing import Any

import pytest

from rover_rl import RoverEnv, make_env
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.warp import WarpSettings

EVERY = (BulletSettings, WarpSettings, MujocoSettings)


@pytest.mark.parametrize(
    ("kinds", "settings", "message"),
    [
        (EVERY, {"substeps": 0}, "substeps must be at least 1, got 0"),
        (EVERY, {"control_dt": 0.0}, "control_dt must be positive, got 0.0"),
        (EVERY, {"ground_friction": -0.1}, "ground_friction must not be negative, got -0.1"),
        ((BulletSettings,), {"ground_friction": math.nan}, "ground_friction must not be negative, got nan"),
        ((BulletSettings,), {"substeps": 5}, "substeps must be an even number of at least 2, got 5"),
        ((WarpSettings, MujocoSettings), {"threads": 0}, "threads must be at least 1, got 0"),
        ((WarpSettings,), {"lidar_lanes": 3}, "lidar_lanes must be 1, 2, 4, 8, 16 or 32, got 3"),
        ((WarpSettings,), {"block_size": 48}, "block_size must be a multiple of 32 from 32 to 1024, got 48"),
        ((MujocoSettings,), {"stiffness": math.nan}, "stiffness must be positive, got nan"),
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
        ("ros2", "backend 'ros2' has no presets"),
        (BulletSettings(), "settings of its own"),
    ],
)
def test_unknown_presets_raise_with_the_allowed_names(backend: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RoverEnv(backend=backend, physics="exact")


@pytest.mark.parametrize("name", list(BulletSettings.presets))
def test_a_preset_is_selected_by_name_and_has_a_control_rate_of_20_hz(name: str) -> None:
    env = make_env(world_n="maze", num_envs=2, physics=name)
    settings = env.base_env.simulator.settings
    assert settings == BulletSettings(**BulletSettings.presets[name])
    assert settings.control_dt == settings.substep * settings.substeps == 0.05
    env.rollout(3)
    env.close()


def test_missing_mujoco_raises_with_install_command(monkeypatch):
    for name in [name for name in sys.modules if name.startswith(("rover_rl.sims.mujoco.", "rover_rl.native."))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"backend='mujoco' needs MuJoCo: pip install 'rover_rl\[mujoco\]'"):
        RoverEnv(backend="mujoco")
