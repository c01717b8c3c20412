"""Reset of a ROS 2 environment after close()."""

from __future__ import annotations

import pytest

from rover_rl import RoverEnv
from rover_rl.envs.gym import RoverEnv as GymRoverEnv
from rover_rl.sims.ros2 import Ros2Settings
from tests.sims.ros2.wire import Wire

SETTINGS = {"world_n": "maze", "backend": Ros2Settings(reset="none"), "connection_check_timeout": 0}


def test_reset_after_close_reconnects(wire: Wire) -> None:
    env = RoverEnv(**SETTINGS)
    env.reset()
    env.close()
    assert wire.closed
    assert wire.subscribers("/scan") == 1
    env.reset()
    assert wire.subscribers("/scan") == 2
    env.close()


def test_a_closed_gymnasium_env_stays_closed(wire: Wire) -> None:
    env = GymRoverEnv(**SETTINGS)
    env.reset()
    env.close()
    with pytest.raises(RuntimeError, match="closed environment"):
        env.reset()
    assert wire.subscribers("/scan") == 1
