"""Registration of custom backends."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pytest
import torch

from rover_rl import RoverEnv
from rover_rl.sims import Backend, Simulator, backend_names, backends, make_simulator, register_backend
from rover_rl.sims.bullet import BulletSettings, BulletSimulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain, World

ROVER = get_robot("rover_zero")
FLAT = World("flat", Terrain.flat((20, 20)))


@pytest.fixture(autouse=True)
def temporary_registry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Removes registrations after each test, because other tests compare the list of names."""
    monkeypatch.setattr(backends._REGISTRY, "_parts", dict(backends._REGISTRY._parts))


@dataclass(frozen=True)
class CustomSettings:
    """Settings of a custom backend: Bullet with a number of substeps."""

    substeps: int = 4

    def make(self, *, worlds, robot, lidar_beams, connection=None, device=None) -> Simulator:
        return BulletSimulator(worlds, robot, lidar_beams, BulletSettings(substeps=self.substeps))

    @classmethod
    def preset(cls, name: str) -> CustomSettings:
        return cls({"coarse": 2}[name])


class PlainBackend:
    """Backend without settings and presets."""

    def make(self, *, worlds, robot, lidar_beams, connection=None, device=None) -> Simulator:
        return BulletSimulator(worlds, robot, lidar_beams)


def substeps(backend: Any, **arguments: Any) -> int:
    """Builds and closes a simulator. Returns the number of its substeps."""
    simulator = make_simulator(backend, worlds=[FLAT], robot=ROVER, lidar_beams=8, **arguments)
    simulator.close()
    return simulator.settings.substeps


def test_a_registered_class_of_settings():
    register_backend("registered-class", CustomSettings)
    assert "registered-class" in backend_names()
    assert substeps("registered-class") == 4
    assert substeps("registered-class", physics="coarse") == 2
    assert substeps(CustomSettings(6)) == 6


def test_a_registered_object():
    backend = CustomSettings(8)
    assert isinstance(backend, Backend)
    register_backend("registered-object", backend)
    assert substeps("registered-object") == 8


def test_backends_by_import_path(tmp_path, monkeypatch):
    source = (
        "from rover_rl.sims.bullet import BulletSettings, BulletSimulator\n"
        "class Settings:\n"
        "    def make(self, *, worlds, robot, lidar_beams, connection=None, device=None):\n"
        "        return BulletSimulator(worlds, robot, lidar_beams, BulletSettings(substeps=12))\n"
        "backend = Settings()\n"
    )
    (tmp_path / "registration_test_backends.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    register_backend("registered-path", "registration_test_backends:Settings")
    for name in ("registration_test_backends:Settings", "registration_test_backends:backend", "registered-path"):
        assert substeps(name) == 12


def test_an_environment_uses_a_registered_backend():
    register_backend("registered-for-env", CustomSettings)
    env = RoverEnv(world_n=FLAT, num_envs=2, backend="registered-for-env")
    assert env.simulator.settings.substeps == 4
    td = env.rollout(3)
    assert torch.isfinite(td["pose"]).all()
    env.close()


def test_a_backend_without_presets_raises_for_a_preset():
    register_backend("registered-plain", PlainBackend)
    assert substeps("registered-plain") == BulletSettings().substeps
    with pytest.raises(
        ValueError, match="^backend 'registered-plain' has no presets for its physics, got physics='fast'$"
    ):
        substeps("registered-plain", physics="fast")


def test_a_function_that_returns_a_backend_is_called():
    register_backend("registered-function", lambda: CustomSettings())
    assert substeps("registered-function") == substeps(CustomSettings())


@pytest.mark.parametrize(("name", "part"), [("registered-number", 4), ("registered-function-of-a-number", lambda: 4)])
def test_anything_without_make_raises(name, part):
    register_backend(name, part)
    with pytest.raises(
        ValueError, match=r"^backend must be one of \[.*\], settings of one, or an object with a make\(\)"
    ):
        substeps(name)


def test_names_of_built_in_backends_are_taken():
    with pytest.raises(ValueError, match="^a backend named 'bullet' already exists; choose another name$"):
        register_backend("bullet", CustomSettings)
    assert substeps("bullet") == BulletSettings().substeps
