"""Contact forces and motor torques in Bullet, summed over the physics steps of a control step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.native.bullet import pybullet
from rover_rl.sims.rover_state import SIDES, Force, by_side

_NORMAL, _NORMAL_FORCE = 7, 9
"""Indices in a contact point of PyBullet: the normal on the second body, toward the first one, and the force, N."""
_TORQUE = 3
"""Index of the torque of the motor in the state of a joint, N m."""


class Meters:
    """Measures the rovers of one world.

    Args:
        reports: arrays for the fields that are asked for, ``[count, k]`` each.
        rovers: client and body of each rover.
        wheels: joints of the wheels with motors.
        inertial: orientation of the inertial frame in the base frame, (x, y, z, w). Bullet states that of the former.
        substeps: number of physics steps of a control step.
    """

    def __init__(
        self,
        reports: Mapping[Force, np.ndarray],
        rovers: Sequence[tuple[int, int]],
        wheels: Sequence[int],
        inertial: np.ndarray,
        substeps: int,
    ) -> None:
        self.reports, self._rovers, self._wheels = reports, rovers, wheels
        self._to_base, self._substeps = Rotation.from_quat(inertial).inv(), substeps
        self._of_client: dict[int, list[tuple[int, int]]] = {}
        for row, (client, rover) in enumerate(rovers):
            self._of_client.setdefault(client, []).append((row, rover))
        self._pushes: list[tuple[int, int, Sequence[float], Sequence[float]]] = []
        self._torques = np.zeros((len(rovers), len(wheels)))

    def read(self, client: int, near: Iterable[tuple[int, int, bool]]) -> None:
        """Reads what acts in a physics step that a client has just taken.

        Args:
            client: client.
            near: rows and bodies that may touch, and whether the body is of a mover.
        """
        if "contact_force" in self.reports:
            for row, body, moves in near:
                self._feel(row, body, len(SIDES) if moves else 0)
        if "wheel_torque" in self.reports:
            for row, rover in self._of_client[client]:
                states = pybullet.getJointStates(rover, self._wheels, client)
                self._torques[row] += [state[_TORQUE] for state in states]

    def _feel(self, row: int, body: int, column: int) -> None:
        client, rover = self._rovers[row]
        points = pybullet.getContactPoints(rover, body, physicsClientId=client)
        points = [point for point in points if point[_NORMAL_FORCE] > 0.0]
        if points:
            orientation = pybullet.getBasePositionAndOrientation(rover, client)[1]
            for point in points:
                push = [point[_NORMAL_FORCE] * part for part in point[_NORMAL]]
                self._pushes.append((row, column, push, orientation))

    def finish(self, held: Sequence[int]) -> None:
        """Writes the means over a control step to the arrays, except in the rows ``held``."""
        moved = np.setdiff1d(np.arange(len(self._rovers)), held)
        if "contact_force" in self.reports:
            self.reports["contact_force"][moved] = self._forces()[moved]
        if "wheel_torque" in self.reports:
            self.reports["wheel_torque"][moved, : len(self._wheels)] = self._torques[moved] / self._substeps
        self._pushes, self._torques = [], np.zeros_like(self._torques)

    def _forces(self) -> np.ndarray:
        forces = np.zeros((len(self._rovers), 2 * len(SIDES)))
        if self._pushes:
            rows, columns, pushes, orientations = (np.array(part) for part in zip(*self._pushes, strict=True))
            turned = (Rotation.from_quat(orientations) * self._to_base).apply(pushes, inverse=True)
            places = rows[:, None], columns[:, None] + np.arange(len(SIDES))
            np.add.at(forces, places, by_side(turned[:, :2]) / self._substeps)
        return forces
