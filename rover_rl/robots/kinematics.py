"""``Kinematics``: how the commands of a batch of robots move their joints, and how their joints tell how they move."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.robots.drives import Ackermann, Joints
from rover_rl.robots.fleet import Fleet
from rover_rl.rotations import angle_of


class Kinematics:
    """Kinematics of the drives of a batch, a robot per row. A change of the fleet's index is followed.

    A *set point* is what a drive holds between two commands, ``[N, 2]``, or ``[N, 3]`` if a robot moves sideways: the
    twist that it has reached; for a car, its speed (m/s) and the steering angle of the middle of its front axle (rad).
    It is zero at rest. The bits of a row do not depend on other rows: products are sums in a fixed order.

    ``dt`` is the duration of a control step, s.

    Example:
        >>> from rover_rl.robots import get_robot
        >>> kinematics = Kinematics(Fleet.of(get_robot("rover_zero"), 1), 0.05)
        >>> kinematics.odometry(Joints(torch.tensor([[8.0, 12.0]]), torch.zeros(1, 0)))
        tensor([[1.2200, 2.0333]])
    """

    def __init__(self, fleet: Fleet, dt: float) -> None:
        drives = [(robot.drive, robot.wheels) for robot in fleet.robots]
        self.motors = max(len(drive.motors) for drive, _ in drives)
        self.steering = max(len(drive.steering) for drive, _ in drives)
        self.sideways = any(drive.sideways for drive, _ in drives)
        self.size = 3 if self.sideways else 2
        numbers: dict[str, list[Tensor]] = {"matrix": [], "inverse": [], "limit": [], "car": []}
        for drive, wheels in drives:
            # By columns, [n, k] for the product of a matrix [k, n].
            numbers["matrix"].append(_padded(drive.matrix(wheels).T, self.size, self.motors))
            numbers["inverse"].append(_padded(drive.inverse(wheels).T, self.motors, self.size))
            linear, angular = drive.max_linear_acceleration, drive.max_angular_acceleration
            limit, car = dt * torch.tensor((linear, angular, linear)), torch.ones(7)
            if isinstance(drive, Ackermann):
                limit = torch.tensor((linear * dt, drive.max_steering_rate * dt, 0.0))
                sides = [hub[1] for hub in wheels.hubs]
                car = torch.tensor([drive.wheelbase(wheels), wheels.radius, drive.max_steering, *sides])
            numbers["limit"].append(limit[: self.size])
            numbers["car"].append(car)
        cars = [isinstance(drive, Ackermann) for drive, _ in drives]
        self._any_car, self._all_cars = any(cars), all(cars)
        self._fleet, self._index, device = fleet, fleet.index, fleet.index.device
        # Of each robot, [K, ...]. A copy from the host waits for the device: these are copied once.
        self._tables = {name: torch.stack(rows).to(device) for name, rows in numbers.items()}
        self._tables["is_car"] = torch.tensor(cars, device=device)[:, None]
        self._rows = self._of_rows()

    def advance(self, set_point: Tensor, command: Tensor) -> Tensor:
        """Returns the set points after a step with commands of the same shape, within the limits of the drives."""
        rows = self._follow()
        if self._any_car:
            base, _, most = rows["car"][:, :3].split(1, -1)
            speed, yaw_rate = command[:, :1], command[:, 1:2]
            # In reverse, the same yaw rate needs the opposite angle.
            side = torch.where(speed < 0, -yaw_rate, yaw_rate)
            # The bits of this function do not depend on the size of the batch, as those of torch.atan2 do.
            angle = angle_of(torch.stack((speed.abs(), side * base), -1)).clamp(-most, most)
            command = self._choose(torch.cat((speed, angle), -1), command)
        return set_point + torch.clamp(command - set_point, -rows["limit"], rows["limit"])

    def joints(self, before: Tensor, after: Tensor) -> Joints:
        """Returns the targets of the joints in a step from one set point to another, with the speeds of their mean."""
        rows, mean = self._follow(), (before + after) * 0.5
        if not self._any_car:
            return Joints(_product(self._columns["matrix"], mean), mean[:, :0])
        base, radius, _, *sides = rows["car"].split((1, 1, 1, 2, 2), -1)
        curvature = after[:, 1:2].tan() / base
        rear, front = (1 - curvature * side for side in sides)
        angles = angle_of(torch.stack((front, (curvature * base).expand(-1, 2)), -1))
        speeds = mean[:, :1] * rear / radius
        if self._all_cars:
            return Joints(speeds, angles)
        speeds = self._choose(speeds, _product(self._columns["matrix"], mean))
        return Joints(speeds, self._choose(angles, torch.zeros_like(angles)))

    def odometry(self, joints: Joints) -> Tensor:
        """Returns the twists that joints report, ``[N, 2]`` or ``[N, 3]``. Bodies move differently where wheels slip.

        For a car, it is the mean speed of the rear wheels, and the yaw rate by the angles of the front wheels.
        """
        rows = self._follow()
        if not self._any_car:
            return _product(self._columns["inverse"], joints.speeds)
        base, radius, _, _, sides = rows["car"].split((1, 1, 1, 2, 2), -1)
        # The mean of two, in the same order for any layout of the batch.
        speed = (joints.speeds[:, :1] + joints.speeds[:, 1:2]) / 2 * radius
        tangents = joints.angles.tan()
        curvatures = tangents / (base + sides * tangents)
        twist = torch.cat((speed, speed * ((curvatures[:, :1] + curvatures[:, 1:]) / 2)), -1)
        return twist if self._all_cars else self._choose(twist, _product(self._columns["inverse"], joints.speeds))

    def _of_rows(self) -> dict[str, Tensor]:
        rows = self._tables
        # One robot is that of all rows.
        if len(self._fleet.robots) > 1:
            rows = {name: table[self._index] for name, table in rows.items()}
        self._columns = {name: rows[name].unbind(1) for name in ("matrix", "inverse")}
        return rows

    def _follow(self) -> dict[str, Tensor]:
        if self._fleet.index is not self._index and len(self._fleet.robots) > 1:
            self._index = self._fleet.index
            self._rows = self._of_rows()
        return self._rows

    def _choose(self, of_cars: Tensor, of_others: Tensor) -> Tensor:
        if self._all_cars:
            return of_cars
        padded = pad(of_cars, (0, of_others.shape[1] - of_cars.shape[1]))
        return torch.where(self._rows["is_car"], padded, of_others)


def _padded(numbers: Tensor, rows: int, columns: int) -> Tensor:
    return pad(numbers, (0, columns - numbers.shape[1], 0, rows - numbers.shape[0])).contiguous()


def _product(columns: Sequence[Tensor], vectors: Tensor) -> Tensor:
    """Matrices by their columns, ``[N, k]`` or ``[1, k]`` each, times vectors ``[N, n]``: ``[N, k]``."""
    first, *others = zip(vectors.split(1, -1), columns, strict=True)
    result = first[0] * first[1]
    for values, column in others:
        result = torch.addcmul(result, values, column)
    return result
