"""Public names of the package."""

from __future__ import annotations

import subprocess
import sys

import pytest

import rover_rl

PUBLIC_NAMES = """
ENV_ID LEARNING_DEFAULTS LEARNING_ENV_ID __version__ make_env RoverEnv GymWrapper GymVectorWrapper contract_reward
EnvConfig ActionConfig LidarConfig PoseConfig RewardConfig TaskConfig Randomization Bounds Sensor RewardComponent
Robot RobotOptions Terrain World box cylinder
register_backend register_reward register_robot register_sensor register_world
"""


def test_the_public_names_are_these_and_exist() -> None:
    assert sorted(rover_rl.__all__) == sorted(PUBLIC_NAMES.split())
    for name in rover_rl.__all__:
        assert getattr(rover_rl, name) is not None
        assert name in dir(rover_rl)


def test_an_unknown_name_raises() -> None:
    with pytest.raises(AttributeError, match="module 'rover_rl' has no attribute 'Rover'"):
        _ = rover_rl.Rover
    with pytest.raises(ImportError, match="cannot import name 'Rover'"):
        from rover_rl import Rover  # noqa: F401


def test_help_and_registration_do_not_import_pytorch() -> None:
    program = (
        "import sys, gymnasium, rover_rl\n"
        "from rover_rl.cli.main import main\n"
        "assert 'rover_rl/Rover-v0' in gymnasium.registry\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "assert 'torch' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.DEVNULL)
