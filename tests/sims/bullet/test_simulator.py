"""The Bullet simulator: clients, memory, and what it refuses."""

from __future__ import annotations

import gc

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


def connected() -> set[int]:
    """Returns the connected Bullet clients of this process."""
    gc.collect()
    return {client for client in range(1024) if pybullet.isConnected(client)}


def test_a_closed_or_deleted_simulator_leaves_only_the_clients_of_others_connected():
    other = placed("bullet", FLAT, torch.zeros(1, 3))
    before = connected()
    closed, deleted = (placed("bullet", FLAT, torch.zeros(1, 3)) for _ in range(2))
    assert len(connected()) == len(before) + 2
    closed.close()
    closed.close()
    assert len(connected()) == len(before) + 1
    del deleted
    assert connected() == before
    drive(other, (0.0, 0.0), 1)
