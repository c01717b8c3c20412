"""Physics of rovers near movers, in MuJoCo.

Rovers far from all movers do not need the coordinates of their parts, and are simulated without them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from rover_rl.native.mujoco import mujoco
from rover_rl.robots import Robot
from rover_rl.sims.movers.near import NearParts
from rover_rl.sims.mujoco.model import scaled_model
from rover_rl.sims.mujoco.physics import RoverPhysics
from rover_rl.sims.mujoco.settings import MujocoSettings
from rover_rl.sims.rover_state import Force
from rover_rl.worlds.movers import Part

_FAR, _SPACING = 1e4, 10.0
"""Place of parts that are not near, and distance from one to the next, m."""


class RoversAmongMovers(RoverPhysics):
    """Physics of rovers in a model that has parts of movers, too.

    Args:
        model: model of the rover with the parts ``slots``.
        robot: robot.
        count: number of rovers.
        settings: settings of the physics.
        slots: parts of the model, from :func:`~rover_rl.sims.mujoco.parts.slots_of`.
        parts: parts of the movers of the world.
        reports: arrays for the fields that the model measures, ``[count, k]`` each.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        robot: Robot,
        count: int,
        settings: MujocoSettings,
        slots: Sequence[Part],
        parts: Sequence[Part],
        reports: Mapping[Force, np.ndarray],
    ) -> None:
        super().__init__(model, robot, count, settings, reports)
        places = self._coordinates(f"part {index} x" for index in range(len(slots)))
        speeds = self._velocities(f"part {index} x" for index in range(len(slots)))
        # Place of the position and orientation, and of the velocities of each slot in a state.
        self._part_places = np.array(places)[:, None] + np.arange(7)
        self._part_speeds = np.array(speeds)[:, None] + np.arange(6)
        # Place of the rover's coordinates and velocities in a state.
        self._rover = [*range(places[0]), *range(1 + model.nq, speeds[0])]
        self._slots: dict[tuple, list[int]] = {}
        for index, part in enumerate(slots):
            self._slots.setdefault((part.kind, part.size), []).append(index)
        self._form = [(part.kind, part.size) for part in parts]
        self._away = np.zeros((len(slots), 7))
        self._away[:, 0] = _FAR + _SPACING * np.arange(len(slots))
        self._away[:, 3] = 1.0
        self._scales: dict[int, Sequence[float]] = {}

    def set_dynamics(self, row: int, scales: Sequence[float]) -> None:
        """Scales the dynamics of one rover as soon as it is near movers."""
        self._models[row], self._scales[row] = self._model, scales

    def step_from(
        self, states: np.ndarray, near: NearParts, rows: np.ndarray, speeds: np.ndarray, angles: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advances the rovers ``rows [k]`` by one control step, from the states of rovers without movers.

        Args:
            states: states of the rovers ``rows`` before the step, ``[k, S]``.
            near: parts of movers near them.
            rows: rovers, each with at least one part near it.
            speeds: speeds of their motors, ``[k, M]``, rad/s.
            angles: angles of their steering joints, ``[k, S]``, rad.

        Returns:
            Their states after the step, and which of them touched an obstacle or a mover, and which a mover, bool
            ``[k, 2]``.
        """
        for row in self._scales.keys() & set(rows.tolist()):
            scales = self._scales.pop(row)
            if any(scale != 1.0 for scale in scales):
                self._models[row] = scaled_model(self._model, self._settings, *scales)
        self._states[rows[:, None], self._rover] = states
        self._set_parts(rows, near)
        touched = self.step(rows, speeds, angles)
        return self._states[rows[:, None], self._rover], touched

    def _set_parts(self, rows: np.ndarray, near: NearParts) -> None:
        """Sets the positions and velocities of the parts in the states of ``rows``. Those that are not near are far."""
        self._states[rows[:, None, None], self._part_places] = self._away
        self._states[rows[:, None, None], self._part_speeds] = 0.0
        chosen, slots = self._assign(near)
        row, slot = near.row[chosen][:, None], np.array(slots, dtype=int)
        orientation = np.roll(near.orientation[chosen], 1, axis=1)
        places = np.concatenate((near.start[chosen], orientation), 1)
        self._states[row, self._part_places[slot]] = places
        spins = np.zeros((len(chosen), 3))
        for spin, quaternion, turn in zip(spins, orientation, near.turn[chosen].tolist(), strict=True):
            # The speed of a ball joint is in the frame of the body.
            mujoco.mju_rotVecQuat(spin, (0.0, 0.0, turn), quaternion * (1, -1, -1, -1))
        self._states[row, self._part_speeds[slot]] = np.concatenate((near.velocity[chosen], spins), 1)

    def _assign(self, near: NearParts) -> tuple[list[int], list[int]]:
        """Returns the indices of the parts that may push rovers, and the slot of each."""
        chosen, slots = [], []
        used: Counter[tuple] = Counter()
        for index, (row, part) in enumerate(zip(near.row.tolist(), near.part.tolist(), strict=True)):
            form = self._form[part]
            free, number = self._slots[form], used[row, form]
            if number < len(free):
                chosen.append(index)
                slots.append(free[number])
                used[row, form] += 1
        return chosen, slots


def reach_of(model: mujoco.MjModel) -> float:
    """Returns the radius of a sphere around the base frame that contains the rover, m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base = model.body("base").id
    own = np.flatnonzero(model.body_rootid[model.geom_bodyid] == base)
    offsets = np.linalg.norm(data.geom_xpos[own] - data.xpos[base], axis=1)
    return float((offsets + model.geom_rbound[own]).max())
