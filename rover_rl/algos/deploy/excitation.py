"""A drive that tells the numbers of a robot, for ``rover-rl calibrate``: rest, runs, turns, arcs and chirps.

Each run is followed by the same one backward, so that the robot stays around its start.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from tensordict import TensorDictBase

from rover_rl.envs.config import TaskConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.sims.ros2.simulator import Ros2Simulator
from rover_rl.worlds import Terrain, World

CLEARANCE = 0.5  # lidar reading below which the drive ends, m
REST, PAUSE, CHIRP = 15.0, 1.5, 12.0  # durations of the rest at the start, of a rest between runs and of a chirp, s
SHARES = (0.3, 0.6, 1.0, 1.0)  # of the largest speed and yaw rate, in runs
FREQUENCIES = (0.15, 1.0)  # at the start and the end of a chirp of the speed, Hz
TURN_RATIO = 1.7  # frequency of the yaw rate for each of the speed in a chirp
REACTION = 0.4  # time until the robot brakes that is reckoned with, s
GENTLE_BRAKE = 1.0  # largest deceleration that is reckoned with, m/s^2
GENTLE_TURN = 3.0  # largest yaw rate without --max-yaw-rate, rad/s
QUICK = 100.0  # limit of accelerations without --max-acceleration: steps, m/s^2 and rad/s^2
ANYWHERE = World("none", Terrain.flat((20.0, 20.0)), bounds=((-1e6, 1e6), (-1e6, 1e6)))
"""Ground of which nothing is known, on which the pose may be anywhere."""
TASK = TaskConfig(success_distance=1e-6, stuck_threshold=0.0)
"""The robot may stand, and its goal, which is its start, is never reached."""


class Part(NamedTuple):
    """Speed (m/s) and yaw rate (rad/s) that are held, or the amplitudes of a chirp, for a duration, s."""

    speed: float
    turn: float
    seconds: float
    is_chirp: bool = False

    def at(self, time: float) -> tuple[float, float]:
        if not self.is_chirp:
            return self.speed, self.turn
        low, high = FREQUENCIES
        phase = 2 * math.pi * (low + (high - low) * time / (2 * self.seconds)) * time
        return self.speed * math.sin(phase), self.turn * math.sin(TURN_RATIO * phase)


def parts_of(speed: float, turn: float, radius: float, turns_in_place: bool) -> list[Part]:
    """Returns what a robot drives within a radius (m) by its largest speed (m/s) and yaw rate (rad/s)."""
    parts = [Part(0.0, 0.0, REST)]

    def pair(v: float, w: float, first: float, then: float) -> None:
        parts.extend((Part(v, w, first), Part(0.0, 0.0, PAUSE), Part(-v, -w, then), Part(0.0, 0.0, PAUSE)))

    for share in SHARES:
        run = min(2.5, radius / (share * speed) + 0.3)
        pair(share * speed, 0.0, run, run)
        # In place, or in as narrow a bow as it can; another heading for the next run.
        pair(0.0 if turns_in_place else share * speed, share * turn, 2.2, 1.7)
    for v, w in ((1.0, 0.3), (0.6, -0.6), (1.0, -0.5), (0.5, 0.8)):
        pair(v * speed, w * turn, 1.8, 1.8)
    return [*parts, Part(0.7 * speed, 0.4 * turn, CHIRP, True), Part(0.0, 0.0, 2.0)]


class Excitation:
    """Policy with actions ``twist`` that drives what tells the numbers of a live robot, for ``seconds``.

    It begins each run towards the start, and brakes where it would leave the ``radius`` (m) around it.
    """

    def __init__(self, radius: float) -> None:
        self._radius = radius

    def enter(self, env: RoverEnv) -> None:
        assert isinstance(env.simulator, Ros2Simulator)
        self._env, drive, settings = env, env.robot.drive, env.simulator.settings
        turn = min(settings.max_yaw_rate or GENTLE_TURN, drive.max_yaw_rate)
        speed = min(settings.max_speed or math.inf, drive.max_speed)
        self._parts = parts_of(speed, turn, self._radius, drive.turns_in_place)
        self._brake = min(drive.max_linear_acceleration / 2, GENTLE_BRAKE)
        self.seconds = sum(part.seconds for part in self._parts)
        self._begin()

    def start(self) -> tuple[float, float]:
        """Returns the goal of the drive, x and y, m: 1 mm beside the robot at rest, as a drive ends at its goal."""
        self._env.reset()
        x, y = self._env.rover_state.position[0, :2].tolist()
        return x + 1e-3, y

    def _begin(self) -> None:
        self._index, self._time, self._sign, self._blocked = 0, 0.0, 1.0, 0.0

    def __call__(self, observation: TensorDictBase) -> TensorDictBase:
        if observation["outcome", "steps"].item() == 0:
            self._begin()
        else:
            self._time += self._env.rover_state.dt.item()
        (distance, bearing), speed = observation["target"][0].tolist(), observation["velocities"][0, 0].item()
        ahead, left = distance * math.cos(bearing), distance * math.sin(bearing)
        while self._time >= self._parts[self._index].seconds and self._index < len(self._parts) - 1:
            self._time -= self._parts[self._index].seconds
            self._index, self._blocked = self._index + 1, 0.0
            if self._index % 4 == 1:  # a run and its way back have one sign
                self._sign = 1.0 if ahead * self._parts[self._index].speed >= 0 else -1.0
        v, w = (self._sign * each for each in self._parts[self._index].at(self._time))
        # Where it would stop: start, as seen from there.
        gain = 2 * self._brake * REACTION
        fast = min(max(v, speed - gain), speed + gain)
        stop = fast * REACTION + fast * abs(fast) / (2 * self._brake)
        after = math.hypot(ahead - stop, left)
        if v * fast > 0 and distance < after > self._radius:
            self._blocked = math.copysign(1.0, v)
        if v * self._blocked > 0:
            v = w = 0.0
        return observation.set("action", torch.tensor([[v, w]]))
