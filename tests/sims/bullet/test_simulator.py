"""The Bullet simulator: clients, memory, and what it refuses."""

from __future__ import annotations

import gc
import subprocess
import sys

import pytest
import torch

from rover_rl.native.bullet import pybullet
from rover_rl.sims.bullet.simulator import ROVERS_PER_CLIENT
from tests.sims.driven import FLAT, drive, placed


def test_rovers_of_a_batch_with_several_clients_move_as_a_single_rover():
    count = ROVERS_PER_CLIENT + 2
    poses = torch.stack((torch.linspace(-5, 5, count), torch.zeros(count), torch.linspace(-3, 3, count)), 1)
    many, one = placed("bullet", FLAT, poses), placed("bullet", FLAT, poses[-1:])
    a, b = (drive(each, (0.8, 0.7), 20)[-1] for each in (many, one))
    assert torch.equal(a.position[-1], b.position[0])
    assert torch.equal(many.scanner(8).scan()[-1], one.scanner(8).scan()[0])


@pytest.mark.slow
def test_256_rovers_take_less_than_a_gigabyte_resets_leak_no_memory_and_nothing_else_is_printed():
    code = """
import torch
from rover_rl import RoverEnv
def megabytes():
    with open("/proc/self/statm") as f:
        return int(f.read().split()[1]) * 4096 / 1e6
imported = megabytes()
env = RoverEnv(world_n="inspect", num_envs=256, seed=0)
zero = torch.zeros(256, 2)
td = env.reset()
env.step(td.set("action", zero))
peak = megabytes() - imported
for k in range(5):
    env.reset()
warm = megabytes()
for k in range(25):
    env.reset()
print(peak, megabytes() - warm)
env.close()
"""
    if not sys.platform.startswith("linux"):
        pytest.skip("reads the process's memory from /proc")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    peak, growth = map(float, done.stdout.split())
    assert "pybullet" not in done.stderr
    # PyTorch alone takes 420 MB, and the build for CUDA 700.
    assert peak < 550
    # 6,400 resets: a leak of one kilobyte per reset would add 6 MB.
    assert growth < 3


def connected() -> set[int]:
    """Returns the connected Bullet clients of this process."""
    gc.collect()
    return {client for client in range(1024) if pybullet.isConnected(client)}


@pytest.mark.parametrize("end", ["closed", "deleted"])
def test_a_closed_or_deleted_simulator_leaves_only_the_clients_of_others_connected(end):
    other = placed("bullet", FLAT, torch.zeros(1, 3))
    before = connected()
    sim = placed("bullet", FLAT, torch.zeros(1, 3))
    assert connected() > before
    if end == "closed":
        sim.close()
        sim.close()
    else:
        del sim
    assert connected() == before
    drive(other, (0.0, 0.0), 1)
