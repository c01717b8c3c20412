"""Registration of custom backends."""

from __future__ import annotations

import re
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from rover_rl import RoverEnv, make_env
from rover_rl.sims import Backend, Simulator, backend_names, make_simulator, register_backend
from rover_rl.sims.bullet import BulletSettings
from rover_rl.sims.bullet.simulator import BulletSimulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain, World

ROVER = get_robot("rover_zero")
FLAT = World("flat", Terrain.flat((20, 20)))
MAKE = re.escape("make(worlds=, robot=, connection=, device=)")
WANTED = rf"backend must be one of \[.*\], settings of one, or an object with a method {MAKE} that returns a Simulator"
"""Patterns of the error messages."""

pytestmark = pytest.mark.usefixtures("own_registries")


@dataclass(frozen=True)
class CustomSettings:
    """Settings of a custom backend: Bullet with a number of substeps."""

    substeps: int = 4

    def make(self, *, worlds, robot, connection=None, device=None) -> Simulator:
        return BulletSimulator(worlds, robot, BulletSettings(substeps=self.substeps))

    @classmethod
    def preset(cls, name: str) -> CustomSettings:
        return cls({"coarse": 2}[name])


class PlainBackend:
    """Backend without settings and presets."""

    def make(self, *, worlds, robot, connection=None, device=None) -> Simulator:
        return BulletSimulator(worlds, robot)


def substeps(backend: Any, **arguments: Any) -> int:
    """Builds and closes a simulator. Returns the number of its substeps."""
    simulator = make_simulator(backend, worlds=[FLAT], robot=ROVER, **arguments)
    simulator.close()
    return simulator.settings.substeps


def test_a_registered_class_of_settings():
    assert isinstance(CustomSettings(), Backend)
    register_backend("registered-class", CustomSettings)
    assert "registered-class" in backend_names()
    assert substeps("registered-class") == 4
    assert substeps("registered-class", physics="coarse") == 2
    assert substeps(CustomSettings(6)) == 6


def test_backends_by_import_path(tmp_path, monkeypatch):
    source = (
        "from rover_rl.sims.bullet import BulletSettings\n"
        "from rover_rl.sims.bullet.simulator import BulletSimulator\n"
        "class Settings:\n"
        "    def make(self, *, worlds, robot, connection=None, device=None):\n"
        "        return BulletSimulator(worlds, robot, BulletSettings(substeps=12))\n"
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


@pytest.mark.parametrize(("name", "part"), [("registered-number", 4), ("registered-function-of-a-number", lambda: 4)])
def test_anything_without_make_raises(name, part):
    register_backend(name, part)
    with pytest.raises(ValueError, match=f"^{WANTED}, got 4 under the name '{name}'$"):
        substeps(name)


@pytest.mark.parametrize("backend", [object(), 4, None, BulletSettings])
def test_objects_that_are_no_backend_raise_before_anything_is_built(backend):
    with pytest.raises(ValueError, match=f"^{WANTED}, got {re.escape(repr(backend))}$"):
        make_env(world_n=FLAT, backend=backend)


class WithoutRobot:
    """Backend that lacks a keyword of make()."""

    def make(self, *, worlds, connection=None, device=None) -> Simulator:
        raise AssertionError("never called")


def test_a_backend_whose_make_lacks_a_keyword_raises_before_it_is_called():
    with pytest.raises(
        ValueError,
        match=f"^backend .*WithoutRobot object.* must have a method {MAKE}: got an unexpected keyword argument "
        "'robot'$",
    ):
        make_env(world_n=FLAT, backend=WithoutRobot())


def test_a_class_in_place_of_a_backend_raises():
    with pytest.raises(ValueError, match=r"PlainBackend'> must have .*: it is a class; pass an object of it$"):
        make_env(world_n=FLAT, backend=PlainBackend)


def test_errors_inside_make_are_not_replaced():
    class Broken:
        def make(self, **arguments) -> Simulator:
            raise TypeError("inside")

    with pytest.raises(TypeError, match="^inside$"):
        make_env(world_n=FLAT, backend=Broken())


class Returning:
    """Backend whose make() returns a given object."""

    def __init__(self, simulator: Any) -> None:
        self.simulator = simulator

    def make(self, **arguments) -> Any:
        return self.simulator


def test_a_make_that_returns_no_simulator_raises():
    members = "capabilities, close, control_dt, device, num_envs, reset, robot_connected, state, step"
    for simulator in (None, object()):
        with pytest.raises(
            ValueError,
            match=rf"^make\(\) of backend .*Returning.* must return a rover_rl\.sims\.base\.Simulator, got "
            f"{re.escape(repr(simulator))} without {members}$",
        ):
            make_env(world_n=FLAT, backend=Returning(simulator))


@pytest.mark.parametrize("missing", [("step",), ("control_dt", "reset")])
def test_the_missing_attributes_of_a_simulator_are_named(missing):
    whole = make_simulator("bullet", worlds=[FLAT], robot=ROVER)
    names = (*Simulator.__annotations__, "robot_connected", "reset", "state", "step", "render", "close")
    part = SimpleNamespace(**{name: getattr(whole, name) for name in names})
    arguments = {"worlds": [FLAT], "robot": ROVER}
    assert make_simulator(Returning(part), **arguments) is part
    for name in missing:
        delattr(part, name)
    with pytest.raises(ValueError, match=f" without {', '.join(missing)}$"):
        make_simulator(Returning(part), **arguments)
    whole.close()
