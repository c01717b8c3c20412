"""The dependencies in ``pyproject.toml`` and ``requirements.lock``, on every system and Python; the installation."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from itertools import product
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
NOT_FOR_TESTS = {"wandb", "trackio", "mlflow"}
"""Extras that bring hundreds of megabytes: tests use stand-ins."""
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
HAVE_WHEELS = (("linux", "x86_64"), ("darwin", "arm64"), ("win32", "AMD64"))
COMPILE = (("linux", "aarch64"), ("darwin", "x86_64"), ("win32", "ARM64"))


def selected(lines: list[str], python: str, system: str, machine: str) -> dict[str, Requirement]:
    """Returns the requirements whose markers hold on a system, by canonical name."""
    environment = {"python_version": python, "sys_platform": system, "platform_machine": machine, "extra": ""}
    requirements = [Requirement(line) for line in lines]
    chosen = [each for each in requirements if each.marker is None or each.marker.evaluate(environment)]
    assert len({canonicalize_name(each.name) for each in chosen}) == len(chosen)
    return {canonicalize_name(each.name): each for each in chosen}


def pybullets(lines: list[str], python: str, system: str, machine: str) -> set[str]:
    return {name for name in selected(lines, python, system, machine) if name.startswith("pybullet")}


def locked() -> list[str]:
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize(("python", "system"), [*product(PYTHONS, (*HAVE_WHEELS, *COMPILE))])
def test_one_pybullet_is_installed_where_it_has_wheels_and_elsewhere_by_the_extra_bullet_alone(python, system):
    original = python in PYTHONS[:2] if system == HAVE_WHEELS[0] else system in COMPILE
    expected = {"pybullet" if original else "pybullet-arm64"}
    with_wheels = system in HAVE_WHEELS
    assert pybullets(PROJECT["dependencies"], python, *system) == (expected if with_wheels else set())
    assert pybullets(EXTRAS["bullet"], python, *system) == (set() if with_wheels else expected)
    assert pybullets(locked(), python, *system) == expected


@pytest.mark.parametrize("python", PYTHONS)
def test_the_lock_holds_one_allowed_version_of_everything_that_is_needed(python):
    own = Requirement(next(line for line in EXTRAS["dev"] if line.startswith(PROJECT["name"])))
    # Extras may share a requirement, if it is the same.
    lines = {line for extra in own.extras for line in EXTRAS[extra]}
    lines |= {line for line in (*PROJECT["dependencies"], *EXTRAS["dev"]) if Requirement(line).name != own.name}
    needed = selected([*lines], python, "linux", "x86_64")
    pinned = selected(locked(), python, "linux", "x86_64")
    assert set(EXTRAS) == {*own.extras, "dev", *NOT_FOR_TESTS}
    for name, requirement in needed.items():
        (version,) = (pin.version for pin in pinned[name].specifier)
        assert version in requirement.specifier, f"{requirement} and {pinned[name]}"


def beside_a_clone(folder):
    """Puts a clone named rover_rl into a folder, and an environment into which pip installs it for development."""
    clone, environment = folder / "rover_rl", folder / "environment"
    clone.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, clone)
    (clone / "rover_rl").symlink_to(ROOT / "rover_rl")
    venv.create(environment, symlinks=True)
    python = environment / "bin" / "python"
    packages = sysconfig.get_path("purelib", vars={"base": str(environment), "platbase": str(environment)})
    # Sees the packages of the environment of the tests, but not how that has rover_rl: .pth files count in one folder.
    Path(packages, "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    install = ["install", "-qq", "--no-deps", "--no-build-isolation", "--no-input", "-e", str(clone)]
    subprocess.run([sys.executable, "-m", "pip", "--python", str(python), *install], check=True)
    return folder, python


@pytest.mark.slow
def test_an_editable_installation_is_found_beside_the_clone_in_it_and_elsewhere(tmp_path):
    folder, python = beside_a_clone(tmp_path)
    program = "import rover_rl, gymnasium; gymnasium.spec('rover_rl/Rover-v0'); print(rover_rl.__file__)"
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for place in (folder, folder / "rover_rl", Path("/")):
        found = subprocess.run(
            [python, "-c", program], cwd=place, env=variables, check=True, capture_output=True, text=True
        )
        assert found.stdout.strip() == str(folder / "rover_rl" / "rover_rl" / "__init__.py")
