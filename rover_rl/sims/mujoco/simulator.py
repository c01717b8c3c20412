"""MuJoCo backend: batched rovers in one or several worlds, on several threads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rover_rl.native.mujoco import Rollout, mujoco
from rover_rl.robots import Robot
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.mujoco.model import MAX_FELT, make_model, scaled_model
from rover_rl.sims.rover_state import SIDES, Force, by_side
from rover_rl.sims.world_groups import GroupedSimulator, NearParts, WorldGroup
from rover_rl.worlds import World
from rover_rl.worlds.movers import Part

MAX_NEAR = 8
"""Number of parts of one kind and size that may be near a rover. Of more, the nearest ones push it."""
_FAR, _SPACING = 1e4, 10.0
"""Place of parts that are not near, and distance from one to the next, m."""
_POSITION, _ORIENTATION = slice(1, 4), slice(4, 8)
"""Position (m) and orientation (w, x, y, z) of the base frame in a state. The time comes first."""
MIN_ROVERS_PER_THREAD = 4
"""Minimum number of rovers per thread; with fewer, another thread does not pay."""


class RoverPhysics:
    """Physics of ``count`` rovers in one world, from :func:`~rover_rl.sims.mujoco.model.make_model`.

    A rover is one row of MuJoCo's state: time, coordinates and velocities. All rovers share one ``MjData``, into which
    MuJoCo loads a row for each control step, and the solver starts each control step from zero. Nothing else carries
    over, so a rover does not depend on other rovers or on earlier episodes.

    ``states`` holds the rows, and ``reports`` the fields that the model measures, ``[count, k]`` each.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: Robot,
        count: int,
        settings: MujocoSettings,
        reports: Mapping[Force, np.ndarray],
    ) -> None:
        self._model, self._settings, self._reports = model, settings, reports
        self._models, self._data, self._rollout = [model] * count, [mujoco.MjData(model)], Rollout(nthread=0)
        self.states = np.zeros((count, 1 + model.nq + model.nv))
        self.states[:, _ORIENTATION.start] = 1.0
        self._trajectories = np.empty((count, settings.substeps, self.states.shape[1]))
        # The number of all contacts, of those with the ground and of those with movers, and then what else is measured,
        # in each physics step.
        self._contacts = np.empty((count, settings.substeps, model.nsensordata))
        places = {(sensor := model.sensor(index)).name: sensor.adr[0] for index in range(model.nsensor)}
        self._counts = sum(name.endswith("contacts") for name in places)
        self._forces = [places[name] for name in ("force of obstacles", "force of movers") if name in places]
        # About the axle of a wheel, which is the y axis of its frame.
        self._torques = [1 + place for name, place in places.items() if name.startswith("torque")]
        drive, motors = robot.drive, range(len(robot.drive.motors))
        owners = [[f"wheel {k}" for k, own in enumerate(drive.motor_of_wheel) if own == motor] for motor in motors]
        self._motors = [self._velocities(wheels) for wheels in owners]
        self._shafts = self._velocities(f"shaft {motor}" for motor in motors)
        self._steering = self._coordinates(drive.steering)
        rollers = [f"roller {wheel}" for wheel, angle in enumerate(drive.rollers) if angle is not None]
        self._rollers, self._roller_speeds = self._coordinates(rollers), self._velocities(rollers)

    def _coordinates(self, joints: Iterable[str]) -> list[int]:
        """Returns the places of the angles of joints in a state, in which the time comes first."""
        return [1 + self._model.joint(name).qposadr[0] for name in joints]

    def _velocities(self, joints: Iterable[str]) -> list[int]:
        return [1 + self._model.nq + self._model.joint(name).dofadr[0] for name in joints]

    def place(self, rows: np.ndarray, positions: np.ndarray, orientations: np.ndarray) -> None:
        """Places base frames at positions ``[k, 3]`` and orientations (x, y, z, w) ``[k, 4]``, at rest."""
        self.states[rows] = 0.0
        self.states[rows, _POSITION] = positions
        self.states[rows, _ORIENTATION] = np.roll(orientations, 1, axis=1)

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        """Sets the dynamics of one rover, which then has a model of its own."""
        self._models[row] = self._model
        if any(scale != 1.0 for scale in scales):
            self._models[row] = scaled_model(self._model, self._settings, *scales)

    def step(self, rows: np.ndarray, speeds: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Advances the rovers ``rows [k]`` by one control step.

        ``speeds`` of their motors are ``[k, M]``, rad/s, ``angles`` of their steering joints ``[k, S]``, rad. Returns
        which of them touched an obstacle in any of the physics steps, bool ``[k, 1]``; in a model with movers, which
        touched an obstacle or a mover, and which a mover, ``[k, 2]``.
        """
        self.states[rows[:, None], self._shafts] = speeds
        substeps = self._settings.substeps
        for values in self._reports.values():
            values[rows] = 0.0
        if not self._rollers:
            return self._roll(rows, angles, substeps)
        touched = np.zeros((len(rows), self._counts - 1), dtype=bool)
        for _ in range(substeps):
            touched |= self._roll(rows, angles, 1)
            # A roller on the ground keeps its direction, in the mean of a step: only its speed counts.
            rolling = self.states[rows[:, None], self._roller_speeds]
            self.states[rows[:, None], self._rollers] = -0.5 * self._settings.substep * rolling
        return touched

    def _roll(self, rows: np.ndarray, angles: np.ndarray, steps: int) -> np.ndarray:
        trajectories, contacts = self._trajectories[: len(rows), :steps], self._contacts[: len(rows), :steps]
        if steps < self._settings.substeps:
            trajectories, contacts = np.ascontiguousarray(trajectories), np.ascontiguousarray(contacts)
        options: dict[str, Any] = (
            {"control": np.repeat(angles[:, None].astype(float), steps, 1)} if self._steering else {}
        )
        # Checks take longer than the rest of the call.
        options |= {"nstep": steps, "state": trajectories, "sensordata": contacts, "skip_checks": True}
        self._rollout.rollout([self._models[row] for row in rows], self._data, self.states[rows], **options)
        self.states[rows] = trajectories[:, -1]
        if self._reports:
            self._measure(rows, contacts, trajectories[..., _ORIENTATION])
        all_contacts, with_ground, with_movers = np.split(contacts[..., : self._counts], (1, 2), -1)
        touching: np.ndarray = np.concatenate((all_contacts > with_ground, with_movers > 0), -1)
        return np.any(touching, axis=1)

    def _measure(self, rows: np.ndarray, sensors: np.ndarray, orientation: np.ndarray) -> None:
        """Adds the forces and torques of some physics steps to the means over the control step.

        ``sensors`` are readings ``[k, steps, R]``, and ``orientation`` those of the base frames, ``[k, steps, 4]``.
        """
        substeps = self._settings.substeps
        if self._torques:
            # The sensor tells the torque on what carries the wheel.
            self._reports["wheel_torque"][rows] += sensors[..., self._torques].sum(1) / substeps
        for number, place in enumerate(self._forces):
            readings = sensors[..., place : place + 6 * MAX_FELT].reshape(*sensors.shape[:2], MAX_FELT, 6)
            # Along the normal, which points away from the rover.
            pushes = -readings[..., :1] * readings[..., 3:]
            turns = Rotation.from_quat(np.roll(orientation, -1, -1).reshape(-1, 4)).as_matrix()
            turned = pushes @ turns.reshape(*orientation.shape[:2], 3, 3)
            columns = slice(number * len(SIDES), (number + 1) * len(SIDES))
            self._reports["contact_force"][rows, columns] += by_side(turned[..., :2]).sum((1, 2)) / substeps

    def read(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns positions ``[k, 3]`` (m) and orientations (w, x, y, z) ``[k, 4]`` of base frames, and their joints.

        These are the mean speed of the wheels of each motor (rad/s) and the angle of each steering joint (rad),
        ``[k, M + S]``.
        """
        states = self.states[rows]
        joints = [states[:, wheels].mean(1) for wheels in self._motors] + [states[:, angle] for angle in self._steering]
        return states[:, _POSITION], states[:, _ORIENTATION], np.stack(joints, 1)


class RoversAmongMovers(RoverPhysics):
    """Physics of rovers in a model that has parts of movers, too: ``slots``, from :func:`slots_of` the movers' parts.

    Rovers far from all movers do not need the coordinates of these parts, and are simulated without them.
    """

    def __init__(self, slots: Sequence[Part], parts: Sequence[Part], model: mujoco.MjModel, *others: Any) -> None:
        super().__init__(model, *others)
        names = [f"part {index} x" for index in range(len(slots))]
        places, speeds = self._coordinates(names), self._velocities(names)
        # Places of the position and orientation and of the velocities of each slot, and of the rover, in a state.
        self._part_places = np.array(places)[:, None] + np.arange(7)
        self._part_speeds = np.array(speeds)[:, None] + np.arange(6)
        self._rover = [*range(places[0]), *range(1 + model.nq, speeds[0])]
        self._slots: dict[tuple, list[int]] = {}
        for index, part in enumerate(slots):
            self._slots.setdefault((part.kind, part.size), []).append(index)
        self._form = [(part.kind, part.size) for part in parts]
        self._away = np.zeros((len(slots), 7))
        self._away[:, 0], self._away[:, 3] = _FAR + _SPACING * np.arange(len(slots)), 1.0
        self._scales: dict[int, Sequence[float]] = {}

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        """Scales the dynamics of one rover as soon as it is near movers."""
        self._models[row], self._scales[row] = self._model, scales

    def step_from(
        self, states: np.ndarray, near: NearParts, rows: np.ndarray, speeds: np.ndarray, angles: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advances the rovers ``rows [k]``, each near a part, from their states without movers, as :meth:`step`.

        Returns their states after the step, and which of them touched an obstacle or a mover, and which a mover, bool
        ``[k, 2]``.
        """
        for row in self._scales.keys() & set(rows.tolist()):
            super().set_dynamics(row, self._scales.pop(row))
        self.states[rows[:, None], self._rover] = states
        self.states[rows[:, None, None], self._part_places] = self._away
        self.states[rows[:, None, None], self._part_speeds] = 0.0
        self._set_parts(near)
        touched = self.step(rows, speeds, angles)
        return self.states[rows[:, None], self._rover], touched

    def _set_parts(self, near: NearParts) -> None:
        """Sets the positions and velocities of the near parts, in as many slots as there are for their forms."""
        chosen, slots, used = [], [], Counter[tuple]()
        for index, (row, part) in enumerate(zip(near.row.tolist(), near.part.tolist(), strict=True)):
            form = self._form[part]
            if used[row, form] < len(self._slots[form]):
                chosen.append(index)
                slots.append(self._slots[form][used[row, form]])
                used[row, form] += 1
        near, slot = near.chosen(np.array(chosen, dtype=int)), np.array(slots, dtype=int)
        row, orientation = near.row[:, None], np.roll(near.orientation, 1, axis=1)
        self.states[row, self._part_places[slot]] = np.concatenate((near.start, orientation), 1)
        spins = np.zeros((len(chosen), 3))
        for spin, quaternion, turn in zip(spins, orientation, near.turn.tolist(), strict=True):
            # The speed of a ball joint is in the frame of the body.
            mujoco.mju_rotVecQuat(spin, (0.0, 0.0, turn), quaternion * (1, -1, -1, -1))
        self.states[row, self._part_speeds[slot]] = np.concatenate((near.velocity, spins), 1)


def slots_of(parts: Sequence[Part]) -> tuple[Part, ...]:
    """Returns the parts that a rover may meet at once: at most :data:`MAX_NEAR` of each kind and size."""
    forms = Counter((part.kind, part.size) for part in parts)
    example = {(part.kind, part.size): part for part in parts}
    return tuple(example[form] for form, count in forms.items() for _ in range(min(count, MAX_NEAR)))


def reach_of(model: mujoco.MjModel) -> float:
    """Returns the radius of a sphere around the base frame that contains the rover, m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base = model.body("base").id
    own = np.flatnonzero(model.body_rootid[model.geom_bodyid] == base)
    offsets = np.linalg.norm(data.geom_xpos[own] - data.xpos[base], axis=1)
    return float((offsets + model.geom_rbound[own]).max())


class MujocoSimulator(GroupedSimulator):
    """Simulator in MuJoCo. Rovers in the same world share models."""

    def __init__(self, worlds: Sequence[World], robot: Robot, settings: MujocoSettings | None = None) -> None:
        settings = settings or MujocoSettings()
        self._models = cache(partial(make_model, robot, settings.for_mass(robot.mass)))
        threads = settings.threads or torch.get_num_threads()
        super().__init__(worlds, robot, settings, min(threads, max(1, len(worlds) // MIN_ROVERS_PER_THREAD)))

    def _group(self, world: World, rows: slice) -> WorldGroup:
        return MujocoGroup(world, rows, self._robot, self.settings, self._models)


class MujocoGroup(WorldGroup):
    """Rovers in one world, on one thread.

    Rovers near movers are simulated in a model that has their parts, too. ``models`` makes models of a rover in a
    world, with parts of movers, which measure fields.
    """

    def __init__(
        self, world: World, rows: slice, robot: Robot, settings: MujocoSettings, models: Callable[..., mujoco.MjModel]
    ) -> None:
        super().__init__(world, rows)
        self._robot, self._settings, self._models = robot, settings, models
        self._among: RoversAmongMovers | None = None
        self.measure({})

    def measure(self, reports: Mapping[Force, np.ndarray]) -> None:
        self._reports, model = reports, self._models(self.world, (), frozenset(reports))
        self._physics = RoverPhysics(model, self._robot, len(self.every), self._settings, reports)

    def add_movers(self, parts: Sequence[Part]) -> None:
        slots = slots_of(parts)
        model = self._models(self.world, slots, frozenset(self._reports))
        self.reach = reach_of(model)
        others = self._robot, len(self.every), self._settings, self._reports
        self._among = RoversAmongMovers(slots, parts, model, *others)

    def place(self, local: np.ndarray, position: np.ndarray, orientation: np.ndarray) -> None:
        self._physics.place(local, position, orientation)

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        for physics in (self._physics, self._among):
            if physics is not None:
                physics.set_dynamics(row, scales)

    def step(
        self, local: np.ndarray, speeds: np.ndarray, angles: np.ndarray, near: NearParts | None = None
    ) -> np.ndarray:
        physics, among = self._physics, self._among
        if near is None or among is None:
            return physics.step(local, speeds[local], angles[local])
        touched = np.zeros((len(local), 2), dtype=bool)
        beside = np.isin(local, near.row)
        if not beside.all():
            rows = local[~beside]
            touched[~beside, :1] = physics.step(rows, speeds[rows], angles[rows])
        if beside.any():
            rows, near = local[beside], near.chosen(np.flatnonzero(np.isin(near.row, local)))
            states, touched[beside] = among.step_from(physics.states[rows], near, rows, speeds[rows], angles[rows])
            physics.states[rows] = states
        return touched

    def read(self, local: np.ndarray) -> np.ndarray:
        self.position[local], orientation, joints = self._physics.read(local)
        return np.concatenate((self.position[local], np.roll(orientation, -1, axis=1), joints), 1)
