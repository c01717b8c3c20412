"""Physics presets and custom settings."""

from __future__ import annotations

import math

import pytest
import torch

from rover_rl import RoverEnv, Terrain, World, make_env
from rover_rl.sims import make_simulator
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.bullet.settings import PRESETS
from rover_rl.sims.robots import get_robot


@pytest.mark.parametrize("name", list(PRESETS))
def test_a_preset_is_selected_by_name(name: str) -> None:
    env = make_env(world_n="maze", num_envs=2, physics=name)
    assert env.base_env.simulator.settings == PRESETS[name]
    env.rollout(3)
    env.close()


def test_default_settings_are_the_default_preset() -> None:
    assert RoverEnv(world_n="maze").simulator.settings == PRESETS["default"] == BulletSettings()


@pytest.mark.parametrize("settings", list(PRESETS.values()), ids=list(PRESETS))
def test_every_preset_has_a_control_rate_of_20_hz(settings: BulletSettings) -> None:
    assert settings.control_dt == settings.substep * settings.substeps == 0.05


def test_unknown_presets_raise_with_the_allowed_names() -> None:
    with pytest.raises(ValueError, match=r"unknown physics 'exact'; use one of \['default', 'accurate', 'fast'\]"):
        RoverEnv(physics="exact")
    with pytest.raises(ValueError, match="backend 'ros2' has no presets"):
        RoverEnv(backend="ros2", physics="fast")
    with pytest.raises(ValueError, match="settings of its own"):
        RoverEnv(backend=BulletSettings(), physics="fast")


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("substeps", 5),
        ("substeps", 0),
        ("solver_iterations", 0),
        ("control_dt", 0.0),
        ("solver_residual", -1.0),
        ("ground_friction", math.nan),
    ],
)
def test_settings_out_of_range_raise(setting: str, value: float) -> None:
    with pytest.raises(ValueError, match=setting):
        BulletSettings(**{setting: value})


@pytest.mark.slow
def test_accurate_has_a_smaller_error_than_fast() -> None:
    x = torch.arange(81) * 0.25 - 10
    world = World("slope", Terrain((0.15 * x).expand(81, -1), 0.25))
    random = torch.Generator().manual_seed(0)
    starts = torch.rand(12, 3, generator=random) * torch.tensor((8, 8, 2 * math.pi)) - torch.tensor((4, 4, 0))
    commands = torch.rand(12, 2, generator=random) * torch.tensor((1.6, 3.0)) - torch.tensor((0.6, 1.5))

    def final_positions(settings: BulletSettings) -> torch.Tensor:
        simulator = make_simulator(settings, worlds=[world] * 12, robot=get_robot("rover_zero"))
        simulator.reset(torch.ones(12, dtype=torch.bool), starts)
        states = [simulator.step(commands) for _ in range(40)]
        simulator.close()
        return states[-1].position

    reference = final_positions(BulletSettings(substeps=50))
    errors = {name: (final_positions(PRESETS[name]) - reference).norm(dim=-1).median() for name in ("accurate", "fast")}
    assert errors["accurate"] < errors["fast"]
