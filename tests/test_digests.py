"""Rollouts are the same, to the last bit, as when ``digests.json`` was written: by world, robot and simulator.

Floating-point results depend on the processor and on the versions of the libraries, so that the file has digests for
each machine that they were made on, and the tests are skipped elsewhere. After a change of numbers on purpose, write
the file again, and on another machine add its digests, both with::

    python -m tests.test_digests
"""

from __future__ import annotations

import hashlib
import json
import platform
import re
import sys
from importlib.metadata import version
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase

from rover_rl import make_env

FILE = Path(__file__).with_name("digests.json")
CASES = [
    *(("moon", "rover_zero", backend) for backend in ("bullet", "warp", "mujoco")),
    ("inspect", "rover_zero", "bullet"),
    ("maze", "rover_zero", "warp"),
    ("hills:3", "rover_zero", "warp"),
    ("plaza:3", "rover_zero", "warp"),
    ("maze", "racer", "warp"),
    ("maze", "hunter", "bullet"),
    ("maze", "jackal", "mujoco"),
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
    stored, case = json.loads(FILE.read_text()), f"{world} {robot} {backend}"
    if case not in stored.get(machine(), {}):
        pytest.skip(f"the digest was made on {[name for name, cases in stored.items() if case in cases]}")
    assert digest(world, robot, backend) == stored[machine()][case]


if __name__ == "__main__":
    torch.set_num_threads(1)
    made = {" ".join(case): digest(*case) for case in CASES}
    old = json.loads(FILE.read_text())
    # Elsewhere, what has changed here is no longer known.
    same = {case for case, value in made.items() if old.get(machine(), made).get(case) == value}
    kept = {name: {case: cases[case] for case in cases if case in same} for name, cases in old.items()}
    FILE.write_text(json.dumps({**kept, machine(): made}, indent=1) + "\n")
