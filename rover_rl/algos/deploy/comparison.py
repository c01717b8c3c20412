"""Comparison of exported policies with the original, on random observations and on those of a drive."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.deploy.plain_policy import STATE_IN, ExportedFunction, PlainPolicy, input_names, robot_numbers
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.seen_map.scans import lidar_mount
from rover_rl.envs.seen_map.seen_map import BOUNDS
from rover_rl.envs.sensors.scan_pose import scan_pose_now
from rover_rl.envs.sensors.suite import LIDAR_MASK, ROBOT, policy_sensors

CHECKED = 1000  # number of observations on which an exported policy is compared with the original
CHECKED_DRIVE, CHECKED_JUMPS = 100, 20
"""Number of decisions of a drive, and of random observations after it, on which a policy with a map is compared."""
EQUAL_SHARE = 0.99
"""Share of the decisions of a policy with a map that must be within the tolerance.

Sines and cosines of other libraries may differ in the last bit. If a beam ends that close to the edge of a cell,
another cell is marked, and the route may differ for a while."""
_DECISION = 0.2  # time between two decisions of the drive, s
_YARD = 7.0  # half of the width of the yard, m
_WALLS = 24  # number of walls in the yard


def action_difference(checkpoint: Checkpoint, exported: ExportedFunction, policy: PlainPolicy) -> float:
    """Returns the largest difference of actions, with a map in ``EQUAL_SHARE`` of the decisions; NaN if one is."""
    if BOUNDS in policy.inputs:
        drive, jumps = drive_observations(checkpoint, CHECKED_DRIVE), random_observations(checkpoint, CHECKED_JUMPS)
        observations = {key: torch.cat((drive[key], jumps[key])) for key in drive}
    else:
        observations = random_observations(checkpoint, CHECKED)
    runner, state = PolicyRunner(checkpoint.make_actor(), action_repeat=1), torch.zeros(1, policy.state_size)
    rows, differences = TensorDict(observations).auto_batch_size_(1), []
    if ROBOT in checkpoint.config.network.observation:
        rows[ROBOT] = robot_numbers(checkpoint).expand(len(rows), -1)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        # Only a policy with a state decides on one observation after another.
        expected = torch.cat([runner(part) for part in rows.split(1 if policy.state_size else len(rows))])
        for row, original in zip(rows.split(1), expected, strict=True):
            action = exported({**row.exclude(ROBOT), STATE_IN: state})
            if policy.state_size:
                action, state = action
            differences.append((action - original).abs().max())
    share = EQUAL_SHARE if BOUNDS in policy.inputs else 1.0
    return float(torch.stack(differences).quantile(share, interpolation="lower"))


def random_observations(checkpoint: Checkpoint, count: int) -> dict[str, Tensor]:
    """Draws inputs ``[count, n]`` of a policy, except its state, uniformly within their bounds, with seed 0."""
    generator = torch.Generator().manual_seed(0)
    sensors = policy_sensors(checkpoint.env.lidar, checkpoint.env.own_sensors)
    drawn = {}
    for key in input_names(checkpoint.config.network):
        if key == BOUNDS:
            drawn[key] = torch.tensor((-1.0, -1.0, 1.0, 1.0)) * (20 + 80 * torch.rand(count, 4, generator=generator))
        elif key != STATE_IN:
            low, high = sensors[key].bounds.tensors(None)
            drawn[key] = low + (high - low) * torch.rand(count, len(low), generator=generator)
    return drawn


def drive_observations(checkpoint: Checkpoint, count: int) -> dict[str, Tensor]:
    """Returns inputs ``[count, n]``, except the state, of consecutive decisions of a drive, for a policy with a map.

    The rover drives a figure of eight in a yard with random walls, which it sees but does not feel, on ground with
    small waves. Every fifth second it gets a new goal. At a quarter of the drive, it stands on a steep slope.
    """
    generator = torch.Generator().manual_seed(1)
    observations = random_observations(checkpoint, count)
    time = _DECISION * torch.arange(count)
    phase = 2 * math.pi * time / 40
    position = torch.stack((5 * phase.sin(), 3 * (2 * phase).sin()), -1)
    yaw = torch.atan2(6 * (2 * phase).cos(), 5 * phase.cos())
    pitch = 0.04 * (3 * time).sin()
    pitch[count // 4] = -0.5
    observations["imu"] = torch.stack((pitch, 0.04 * (2 * time).cos(), yaw), -1)
    observations["pose"] = torch.cat((position, 0.2 * (3 * time).cos()[:, None]), -1)
    goals = 2 * _YARD * torch.rand(1 + count // 25, 2, generator=generator) - _YARD
    offset = goals[torch.arange(count) // 25] - position
    bearing = torch.remainder(torch.atan2(offset[:, 1], offset[:, 0]) - yaw + math.pi, 2 * math.pi) - math.pi
    observations["target"] = torch.stack((offset.norm(dim=-1), bearing), -1)
    observations["lidar"] = _readings(checkpoint, position, yaw, generator)
    if SCAN_POSE in observations:
        # The rover has moved on since the scan.
        observations[SCAN_POSE] = scan_pose_now(observations["imu"])
        observations[SCAN_POSE][:, [0, 5]] += torch.stack((-0.1 * time.cos().abs(), 0.1 * time.sin()), -1)
    if LIDAR_MASK in observations:
        observations[LIDAR_MASK] = (observations[LIDAR_MASK] > 0.3).float()
    observations[BOUNDS] = torch.tensor((-_YARD, -_YARD, _YARD, _YARD)).repeat(count, 1)
    return observations


def _readings(checkpoint: Checkpoint, position: Tensor, yaw: Tensor, generator: torch.Generator) -> Tensor:
    """Returns the lidar readings ``[count, points]`` at positions ``[count, 2]`` and yaws ``[count]`` in the yard."""
    mount, lidar = lidar_mount(checkpoint.env.robot), checkpoint.env.lidar
    cos, sin = yaw.cos(), yaw.sin()
    origin = position + torch.stack((mount[0] * cos - mount[1] * sin, mount[0] * sin + mount[1] * cos), -1)
    angles = yaw[:, None] + torch.arange(lidar.points) * (2 * math.pi / lidar.points)
    beams = torch.stack((angles.cos(), angles.sin()), -1)[:, :, None]
    start = 2 * _YARD * torch.rand(_WALLS, 2, generator=generator) - _YARD
    along = 3 * torch.rand(_WALLS, 2, generator=generator) - 1.5
    first = (start - origin[:, None])[:, None]
    # Where the beam and the line of the wall meet, as a length of the beam and as a share of the wall.
    across = _cross(beams, along)
    length, share = _cross(first, along) / across, _cross(first, beams) / across
    length = torch.where((length > 0) & (share >= 0) & (share <= 1), length, math.inf)
    noise = 0.01 * torch.randn(angles.shape, generator=generator)
    return (length.amin(-1) + noise).clamp(0.0, lidar.max_range)


def _cross(one: Tensor, other: Tensor) -> Tensor:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]
