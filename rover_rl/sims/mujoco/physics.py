"""Rigid-body physics of rovers in one world, in MuJoCo."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.native.mujoco import Rollout, mujoco
from rover_rl.robots import Robot
from rover_rl.sims.mujoco.model import MAX_FELT, scaled_model
from rover_rl.sims.mujoco.settings import MujocoSettings
from rover_rl.sims.rover_state import SIDES, Force, by_side

_POSITION, _ORIENTATION = slice(1, 4), slice(4, 8)
"""Position (m) and orientation (w, x, y, z) of the base frame in a state. The time comes first."""


class Reading(NamedTuple):
    """Poses and joints of ``k`` rovers, float64.

    Positions ``[k, 3]`` (m) and quaternions (w, x, y, z) ``[k, 4]`` of the base frames; mean speed of the wheels of
    each motor (rad/s) and angle of each steering joint (rad), ``[k, M + S]``.
    """

    position: np.ndarray
    orientation: np.ndarray
    joints: np.ndarray


class RoverPhysics:
    """Physics of ``count`` rovers in one world, from :func:`~rover_rl.sims.mujoco.model.make_model`.

    A rover is one row of MuJoCo's state: time, coordinates and velocities. All rovers share one ``MjData``, into which
    MuJoCo loads a row for each control step, and the solver starts each control step from zero. Nothing else carries
    over, so a rover does not depend on other rovers or on earlier episodes.

    ``reports`` are arrays for the fields that the model measures, ``[count, k]`` each.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: Robot,
        count: int,
        settings: MujocoSettings,
        reports: Mapping[Force, np.ndarray],
    ) -> None:
        self._settings = settings
        self._model = model
        self._models = [model] * count
        self._data = [mujoco.MjData(model)]
        self._rollout = Rollout(nthread=0)
        self._states = np.zeros((count, 1 + model.nq + model.nv))
        self._trajectories = np.empty((count, settings.substeps, self._states.shape[1]))
        # The number of all contacts, of those with the ground and of those with movers, and then what else is measured,
        # in each physics step.
        self._contacts = np.empty((count, settings.substeps, model.nsensordata))
        places = {(sensor := model.sensor(index)).name: sensor.adr[0] for index in range(model.nsensor)}
        self._counts = sum(name.endswith("contacts") for name in places)
        self.reports = reports
        self._forces = [places[name] for name in ("force of obstacles", "force of movers") if name in places]
        # About the axle of a wheel, which is the y axis of its frame.
        self._torques = [1 + place for name, place in places.items() if name.startswith("torque")]
        self._states[:, _ORIENTATION.start] = 1.0
        drive, motors = robot.drive, range(len(robot.drive.motors))
        owners = [[f"wheel {k}" for k, own in enumerate(drive.motor_of_wheel) if own == motor] for motor in motors]
        self._motors = [self._velocities(wheels) for wheels in owners]
        self._shafts = self._velocities(f"shaft {motor}" for motor in motors)
        self._steering = self._coordinates(drive.steering)
        rollers = [f"roller {wheel}" for wheel, angle in enumerate(drive.rollers) if angle is not None]
        self._rollers, self._roller_speeds = self._coordinates(rollers), self._velocities(rollers)

    def _coordinates(self, joints: Iterable[str]) -> list[int]:
        """Returns the places of the angles of joints in a state. The time comes first."""
        return [1 + self._model.joint(name).qposadr[0] for name in joints]

    def _velocities(self, joints: Iterable[str]) -> list[int]:
        """Returns the places of the speeds of joints in a state."""
        return [1 + self._model.nq + self._model.joint(name).dofadr[0] for name in joints]

    def states(self, rows: np.ndarray) -> np.ndarray:
        """Returns the states of the given rovers."""
        return self._states[rows]

    def set_states(self, rows: np.ndarray, states: np.ndarray) -> None:
        """Sets the states of the given rovers."""
        self._states[rows] = states

    def place(self, rows: np.ndarray, positions: np.ndarray, orientations: np.ndarray) -> None:
        """Places base frames at positions ``[k, 3]`` and orientations (x, y, z, w) ``[k, 4]``, at rest."""
        self._states[rows] = 0.0
        self._states[rows, _POSITION] = positions
        self._states[rows, _ORIENTATION] = np.roll(orientations, 1, axis=1)

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        """Scales friction, chassis mass and motor torque of one rover, which then has a model of its own."""
        self._models[row] = self._model
        if any(scale != 1.0 for scale in scales):
            self._models[row] = scaled_model(self._model, self._settings, *scales)

    def step(self, rows: np.ndarray, speeds: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Advances the rovers ``rows [k]`` by one control step.

        ``speeds`` of their motors are ``[k, M]``, rad/s, ``angles`` of their steering joints ``[k, S]``, rad. Returns
        which of them touched an obstacle in any of the physics steps, bool ``[k, 1]``; in a model with movers, which
        touched an obstacle or a mover, and which a mover, ``[k, 2]``.
        """
        self._states[rows[:, None], self._shafts] = speeds
        substeps = self._settings.substeps
        for values in self.reports.values():
            values[rows] = 0.0
        if not self._rollers:
            return self._roll(rows, angles, substeps)
        touched = np.zeros((len(rows), self._counts - 1), dtype=bool)
        for _ in range(substeps):
            touched |= self._roll(rows, angles, 1)
            # A roller on the ground keeps its direction, in the mean of a step: only its speed counts.
            rolling = self._states[rows[:, None], self._roller_speeds]
            self._states[rows[:, None], self._rollers] = -0.5 * self._settings.substep * rolling
        return touched

    def _roll(self, rows: np.ndarray, angles: np.ndarray, steps: int) -> np.ndarray:
        """Advances rovers by some physics steps. Returns what they touched: see :meth:`step`."""
        trajectories, contacts = self._trajectories[: len(rows), :steps], self._contacts[: len(rows), :steps]
        if steps < self._settings.substeps:
            trajectories, contacts = np.ascontiguousarray(trajectories), np.ascontiguousarray(contacts)
        control = {"control": np.repeat(angles[:, None].astype(float), steps, 1)} if self._steering else {}
        # Checks take longer than the rest of the call.
        self._rollout.rollout(
            [self._models[row] for row in rows],
            self._data,
            self._states[rows],
            **control,
            nstep=steps,
            state=trajectories,
            sensordata=contacts,
            skip_checks=True,
        )
        self._states[rows] = trajectories[:, -1]
        if self.reports:
            self._measure(rows, contacts, trajectories[..., _ORIENTATION])
        all_contacts, with_ground, with_movers = np.split(contacts[..., : self._counts], (1, 2), -1)
        touching: np.ndarray = np.concatenate((all_contacts > with_ground, with_movers > 0), -1)
        return np.any(touching, axis=1)

    def _measure(self, rows: np.ndarray, sensors: np.ndarray, orientation: np.ndarray) -> None:
        """Adds the forces and torques of some physics steps to the means over the control step.

        Args:
            rows: rovers ``[k]``.
            sensors: readings of the sensors, ``[k, steps, R]``.
            orientation: orientations (w, x, y, z) of the base frames, ``[k, steps, 4]``.
        """
        substeps = self._settings.substeps
        if self._torques:
            # The sensor tells the torque on what carries the wheel.
            self.reports["wheel_torque"][rows] += sensors[..., self._torques].sum(1) / substeps
        for number, place in enumerate(self._forces):
            readings = sensors[..., place : place + 6 * MAX_FELT].reshape(*sensors.shape[:2], MAX_FELT, 6)
            # Along the normal, which points away from the rover.
            pushes = -readings[..., :1] * readings[..., 3:]
            turns = Rotation.from_quat(np.roll(orientation, -1, -1).reshape(-1, 4)).as_matrix()
            turned = pushes @ turns.reshape(*orientation.shape[:2], 3, 3)
            columns = slice(number * len(SIDES), (number + 1) * len(SIDES))
            self.reports["contact_force"][rows, columns] += by_side(turned[..., :2]).sum((1, 2)) / substeps

    def read(self, rows: np.ndarray) -> Reading:
        """Returns the poses and joints of the given rovers."""
        states = self._states[rows]
        joints = [states[:, wheels].mean(1) for wheels in self._motors] + [states[:, angle] for angle in self._steering]
        return Reading(states[:, _POSITION], states[:, _ORIENTATION], np.stack(joints, 1))
