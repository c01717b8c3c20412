"""Registration of custom backends."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import pytest
import torch

from rover_rl import RoverEnv, make_env
from rover_rl.sims import Backend, Simulator, backend_names, make_simulator, register_backend
from rover_rl.sims.bullet import BulletSettings
from tests.sims.driven import FLAT, ROVER

MAKE = re.escape("make(worlds=, robot=, connection=, device=)")
WANTED = rf"backend must be one of \[.*\], settings of one, or an object with a method {MAKE} that returns a Simulator"
"""Patterns of the error messages."""

pytestmark = pytest.mark.usefixtures("own_registries")


@dataclass(frozen=True)
class CustomSettings:
    """Settings of a custom backend: Bullet with a number of substeps."""

    substeps: int = 4

    def make(self, **arguments: Any) -> Simulator:
        return make_simulator(BulletSettings(substeps=self.substeps), **arguments)

    @classmethod
    def preset(cls, name: str) -> CustomSettings:
        return cls({"coarse": 2}[name])


TWELVE = CustomSettings(12)


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
    env = RoverEnv(world_n=FLAT, num_envs=2, backend="registered-class")
    assert torch.isfinite(env.rollout(3)["pose"]).all()
    env.close()


def test_backends_by_import_path():
    here = "tests.sims.test_registration"
    register_backend("registered-path", f"{here}:CustomSettings")
    assert substeps("registered-path") == substeps(f"{here}:CustomSettings") == 4
    assert substeps(f"{here}:TWELVE") == 12


@pytest.mark.parametrize(("name", "part"), [("registered-number", 4), ("registered-function-of-a-number", lambda: 4)])
def test_anything_without_make_raises(name, part):
    register_backend(name, part)
    with pytest.raises(ValueError, match=f"^{WANTED}, got 4 under the name '{name}'$"):
        substeps(name)


class WithoutRobot:
    """Backend that lacks a keyword of make()."""

    def make(self, *, worlds, connection=None, device=None) -> Simulator:
        raise AssertionError("never called")


class Returning:
    """Backend whose make() returns a given object, or raises it."""

    def __init__(self, result: Any) -> None:
        self.result = result

    def make(self, **arguments) -> Any:
        if isinstance(self.result, Exception):
            raise self.result
        return self.result


RETURNED = r"^make\(\) of backend .* must return a rover_rl.* without"


@pytest.mark.parametrize(
    ("backend", "error", "message"),
    [
        *((each, ValueError, f"^{WANTED}, got {re.escape(repr(each))}$") for each in (object(), 4, BulletSettings)),
        (WithoutRobot(), ValueError, f"^backend .*WithoutRobot object.* must have a method {MAKE}: .* 'robot'$"),
        (Returning, ValueError, r"Returning'> must have .*: it is a class; pass an object of it$"),
        # Errors inside of make() are not replaced.
        (Returning(TypeError("inside")), TypeError, "^inside$"),
        (Returning(None), ValueError, f"{RETURNED} close, control_dt, .* reset, robot_connected, state, step$"),
        (Returning(Simulator()), ValueError, f"{RETURNED} control_dt, device, num_envs$"),
    ],
)
def test_what_is_no_backend_or_makes_no_simulator_raises(backend, error, message):
    with pytest.raises(error, match=message):
        make_env(world_n=FLAT, backend=backend)
