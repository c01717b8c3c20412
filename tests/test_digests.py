"""Rollouts are the same, to the last bit, as when ``digests.json`` was written: by world, robot and simulator.

Floating-point results depend on the processor and on the versions of the libraries, so that the digests hold on the
machines that they were made on, and the tests are skipped elsewhere. After a change of numbers on purpose, write the
file again::

    python -m tests.test_digests
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import sys
from importlib.metadata import version
from itertools import product
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import make_env

FILE = Path(__file__).with_name("digests.json")
BACKENDS = ("bullet", "warp", "mujoco")
CASES = [
    *product(("inspect", "moon", "maze"), ("rover_zero",), BACKENDS),
    *product(("hills:3", "rooms:3", "plaza:3"), ("rover_zero",), ("warp",)),
    *product(("maze",), ("leo", "husky", "racer"), ("warp",)),
    *product(("maze",), ("jackal", "hunter"), BACKENDS),
]
KEYS = ("lidar", "pose", "imu", "target", "velocities", "reward", "terminated", "truncated")
ROVERS, STEPS = 4, 200


def machine() -> str:
    """Processor and libraries that the last bit depends on."""
    model = platform.processor() or platform.machine()
    if sys.platform == "linux":
        found = dict(
            re.findall(r"^(cpu family|model|model name|stepping)\s*: (.*)", Path("/proc/cpuinfo").read_text(), re.M)
        )
        model = " ".join(found.values()) or model
    return ", ".join([model, *(f"{name} {version(name)}" for name in ("torch", "numpy", "warp-lang", "mujoco"))])


def digest(world: str, robot: str, backend: str) -> str:
    env = make_env(world_n=world, robot=robot, num_envs=ROVERS, seed=7, backend=backend)
    generator = torch.Generator().manual_seed(3)

    def act(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", torch.rand(ROVERS, 2, generator=generator) * 2 - torch.tensor([0.6, 1.0]))

    rollout = env.rollout(STEPS, act, break_when_any_done=False)["next"]
    env.close()
    hashed = hashlib.sha256()
    for key in KEYS:
        hashed.update(rollout[key].contiguous().numpy().tobytes())
    return hashed.hexdigest()[:16]


@pytest.mark.parametrize(("world", "robot", "backend"), CASES)
def test_rollouts_have_the_bits_that_they_had(world: str, robot: str, backend: str) -> None:
    stored = json.loads(FILE.read_text())
    if stored["machine"] != machine():
        pytest.skip(f"the digests were made on {stored['machine']}")
    assert digest(world, robot, backend) == stored["digests"][f"{world} {robot} {backend}"]


if __name__ == "__main__":
    torch.set_num_threads(1)
    digests = {" ".join(case): digest(*case) for case in CASES}
    FILE.write_text(json.dumps({"machine": machine(), "digests": digests}, indent=1) + "\n")
