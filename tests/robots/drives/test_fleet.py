"""Different drives in one batch are computed as each one alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from rover_rl.robots import get_robot
from rover_rl.robots.drives import SkidSteer
from rover_rl.robots.fleet import Fleet
from rover_rl.sims.simulated_drives import SimulatedDrives
from tests.robots.drives.vehicles import make_car, make_omni


@dataclass(frozen=True, kw_only=True)
class Lazy(SkidSteer):
    """A drive that changes one method of its class."""

    def advance(self, set_point, command, wheels, dt):
        return super().advance(set_point, command / 2, wheels, dt)


def test_drives_of_all_kinds_in_one_batch_move_their_joints_as_alone(tmp_path):
    rover = get_robot("rover_zero")
    lazy = Lazy(**vars(rover.drive))
    cars = [make_car(tmp_path), make_car(tmp_path, max_steering=0.3, max_linear_acceleration=1.0)]
    robots = [rover, *cars, make_omni(tmp_path), replace(rover, drive=lazy), get_robot("husky")]
    index = torch.tensor([0, 1, 2, 3, 4, 5, 2, 0])
    together = SimulatedDrives.of(Fleet(robots, index), 0.05)
    alone = [SimulatedDrives(robots[k].drive, robots[k].wheels, 0.05, 1) for k in index]
    generator = torch.Generator().manual_seed(0)
    for _ in range(20):
        commands = 2 * torch.rand(len(index), 2, generator=generator) - 0.5
        joints = together.advance(commands, None)
        body = torch.cat((torch.zeros(len(index), 7), joints.speeds, joints.angles), -1)
        state = together.state(body)
        for row, drives in enumerate(alone):
            mine, drive = drives.advance(commands[row : row + 1], None), robots[index[row]].drive
            motors, steering = len(drive.motors), len(drive.steering)
            assert torch.equal(joints.speeds[row, :motors], mine.speeds[0])
            assert torch.equal(joints.angles[row, :steering], mine.angles[0])
            own = drives.state(torch.cat((torch.zeros(1, 7), mine.speeds, mine.angles), -1))
            assert torch.equal(state.linear_velocity[row], own.linear_velocity[0])
            assert torch.equal(state.angular_velocity[row], own.angular_velocity[0])
