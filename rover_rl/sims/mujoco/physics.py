"""Rigid-body physics of rovers in one world, in MuJoCo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rover_rl.sims.mujoco.model import scaled_model
from rover_rl.sims.mujoco.settings import MujocoSettings
from rover_rl.sims.native.mujoco import Rollout, mujoco
from rover_rl.sims.robots import Robot

_POSITION, _ORIENTATION = slice(1, 4), slice(4, 8)
"""Position (m) and orientation (w, x, y, z) of the base frame in a state. The time comes first."""


@dataclass(frozen=True)
class Reading:
    """Poses and wheel speeds of ``k`` rovers, as float64 arrays.

    Attributes:
        position: positions of the base frames, ``[k, 3]``, m.
        orientation: orientations of the base frames, quaternions (w, x, y, z), ``[k, 4]``.
        wheel_speeds: mean speeds of the left and right wheels, ``[k, 2]``, rad/s.
    """

    position: np.ndarray
    orientation: np.ndarray
    wheel_speeds: np.ndarray


class RoverPhysics:
    """Physics of a number of rovers in one world. The rovers do not interact.

    A rover is one row of MuJoCo's state: time, coordinates and velocities. All rovers share one ``MjData``, into which
    MuJoCo loads a row for each control step, and the solver starts each control step from zero. Nothing else carries
    over, so a rover does not depend on other rovers or on earlier episodes.

    Args:
        model: model of a rover in the world, from :func:`rover_rl.sims.mujoco.model.make_model`.
        robot: robot of the model.
        count: number of rovers.
        settings: settings of the physics.
    """

    def __init__(self, model: mujoco.MjModel, robot: Robot, count: int, settings: MujocoSettings) -> None:
        self._settings = settings
        self._model = model
        self._models = [model] * count
        self._data = [mujoco.MjData(model)]
        self._rollout = Rollout(nthread=0)
        self._states = np.zeros((count, 1 + model.nq + model.nv))
        self._trajectories = np.empty((count, settings.substeps, self._states.shape[1]))
        # The number of all contacts and of those with the ground, in each physics step.
        self._contacts = np.empty((count, settings.substeps, model.nsensordata))
        self._states[:, _ORIENTATION.start] = 1.0
        left, wheels = len(robot.left_wheels), len(robot.left_wheels) + len(robot.right_wheels)
        # The velocities are those of the base (6), the wheels and the two shafts.
        first = 1 + model.nq + 6
        self._left, self._right = slice(first, first + left), slice(first + left, first + wheels)
        self._shafts = slice(first + wheels, first + wheels + 2)

    def place(self, rows: np.ndarray, positions: np.ndarray, orientations: np.ndarray) -> None:
        """Places rovers at rest.

        Args:
            rows: indices of the rovers, ``[k]``.
            positions: positions of the base frames, ``[k, 3]``, m.
            orientations: orientations of the base frames, quaternions (x, y, z, w), ``[k, 4]``.
        """
        self._states[rows] = 0.0
        self._states[rows, _POSITION] = positions
        self._states[rows, _ORIENTATION] = np.roll(orientations, 1, axis=1)

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        """Scales friction, chassis mass and motor torque of one rover, which then has a model of its own."""
        self._models[row] = self._model
        if any(scale != 1.0 for scale in scales):
            self._models[row] = scaled_model(self._model, self._settings, *scales)

    def step(self, rows: np.ndarray, speeds: np.ndarray) -> np.ndarray:
        """Advances rovers by one control step.

        Args:
            rows: indices of the rovers, ``[k]``.
            speeds: left and right wheel speed of these rovers, ``[k, 2]``, rad/s.

        Returns:
            Whether each of these rovers touched an obstacle in any of the physics steps, bool ``[k]``.
        """
        self._states[rows, self._shafts] = speeds
        trajectories, contacts = self._trajectories[: len(rows)], self._contacts[: len(rows)]
        # Checks take longer than the rest of the call.
        self._rollout.rollout(
            [self._models[row] for row in rows],
            self._data,
            self._states[rows],
            nstep=self._settings.substeps,
            state=trajectories,
            sensordata=contacts,
            skip_checks=True,
        )
        self._states[rows] = trajectories[:, -1]
        all_contacts, with_ground = contacts[..., 0], contacts[..., 1]
        return np.any(all_contacts > with_ground, axis=1)

    def read(self, rows: np.ndarray) -> Reading:
        """Returns the poses and wheel speeds of the given rovers."""
        states = self._states[rows]
        return Reading(
            position=states[:, _POSITION],
            orientation=states[:, _ORIENTATION],
            wheel_speeds=np.stack((states[:, self._left].mean(1), states[:, self._right].mean(1)), 1),
        )
