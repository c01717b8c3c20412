"""A drive that tells the numbers of a robot, for ``rover-rl calibrate``: rest, runs, turns, arcs and chirps.

Each run is followed by the same one backward, so that the robot stays around its start. A robot that cannot turn in
place drives bows instead, to either side in turn, as narrow as it steers.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase

from rover_rl.envs.config import ActionConfig, EnvConfig, TaskConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.worlds import Terrain, World

CLEARANCE = 0.5  # lidar reading below which the drive ends, m
REST, PAUSE, CHIRP = 15.0, 1.5, 12.0  # durations of the rest at the start, of a rest between runs and of a chirp, s
SHARES = (0.3, 0.6, 1.0, 1.0)  # of the largest speed and yaw rate, in runs
ARCS = ((1.0, 0.3), (0.6, -0.6), (1.0, -0.5), (0.5, 0.8))  # the same in arcs
FREQUENCIES = (0.15, 1.0)  # at the start and the end of a chirp of the speed, Hz
TURN_RATIO, STEER_RATIO = 1.7, 0.6  # frequency of the yaw rate, or of the steering, for each of the speed in a chirp
STEERED = 0.9  # share of the curvature that a car can drive, so that it follows
REACTION = 0.4  # time until the robot brakes that is reckoned with, s
GENTLE_BRAKE = 1.0  # largest deceleration that is reckoned with, m/s^2
GENTLE_TURN = 3.0  # largest yaw rate without --max-yaw-rate, rad/s
QUICK = 100.0  # limit of accelerations without --max-acceleration: steps, m/s^2 and rad/s^2
LIMITS = "max_acceleration", "max_yaw_acceleration"
ANYWHERE = World("none", Terrain.flat((20.0, 20.0)), bounds=((-1e6, 1e6), (-1e6, 1e6)))
"""Ground of which nothing is known, on which the pose may be anywhere."""
TASK = TaskConfig(success_distance=1e-6, stuck_threshold=0.0)
"""The robot may stand, and its goal, which is its start, is never reached."""


class Part(NamedTuple):
    """Speed (m/s) and yaw rate (rad/s) that are held, or the amplitudes of a chirp, for a duration, s.

    The yaw rate of a chirp that ``steers`` is that of a curvature that changes slowly, whatever the speed.
    """

    speed: float
    turn: float
    seconds: float
    is_chirp: bool = False
    steers: bool = False

    def at(self, time: float) -> tuple[float, float]:
        if not self.is_chirp:
            return self.speed, self.turn
        low, high = FREQUENCIES
        phase = 2 * math.pi * (low + (high - low) * time / (2 * self.seconds)) * time
        ahead = math.sin(phase)
        turn = ahead * math.sin(STEER_RATIO * phase) if self.steers else math.sin(TURN_RATIO * phase)
        return self.speed * ahead, self.turn * turn


def parts_of(speed: float, turn: float, radius: float, narrowest: float, acceleration: float) -> list[Part]:
    """Returns what a robot drives within a radius (m) by its largest speed (m/s) and yaw rate (rad/s).

    ``narrowest`` is the radius of its narrowest turn, m; 0 if it turns in place. Else, ``acceleration`` (m/s^2) is the
    largest one to the side in such a turn.
    """
    parts = [Part(0.0, 0.0, REST)]

    def steered(v: float, w: float) -> float:
        most = STEERED * abs(v) / narrowest if narrowest else math.inf
        return max(-most, min(w, most))

    def pair(v: float, w: float, first: float, then: float) -> None:
        w = steered(v, w)
        parts.extend((Part(v, w, first), Part(0.0, 0.0, PAUSE), Part(-v, -w, then), Part(0.0, 0.0, PAUSE)))

    for number, share in enumerate(SHARES):
        run = min(2.5, radius / (share * speed) + 0.3)
        pair(share * speed, 0.0, run, run)
        # Another heading for the next run.
        if narrowest:
            slow = min(speed, math.sqrt(acceleration * narrowest / STEERED))
            pair(share * slow, math.copysign(turn, number % 2 - 0.5), 2.2, 1.7)
        else:
            pair(0.0, share * turn, 2.2, 1.7)
    for v, w in ARCS:
        pair(v * speed, w * turn, 1.8, 1.8)
    chirp = Part(0.7 * speed, steered(0.7 * speed, 0.4 * turn), CHIRP, True, steers=narrowest > 0)
    return [*parts, chirp, Part(0.0, 0.0, 2.0)]


class Excitation:
    """Policy with actions ``twist`` that drives what tells the numbers of a live robot, for ``seconds``.

    It begins each run towards the start, and brakes where it would leave the ``radius`` (m) around it. ``settings``
    limit its speed and yaw rate.
    """

    def __init__(self, radius: float, settings: Ros2Settings) -> None:
        self._radius, self._settings = radius, settings

    def described(self, env: EnvConfig) -> EnvConfig:
        """Returns the environment of a live rover without what keeps it from following at once."""
        limits: Any = {name: QUICK for name in LIMITS if getattr(self._settings, name) is None}
        backend = replace(env.backend, min_reversal=0.0, **limits)
        place = ANYWHERE if env.world == ANYWHERE.name else env.world
        return replace(env, action=ActionConfig(kind="twist"), task=TASK, backend=backend, world=place)

    def enter(self, env: RoverEnv) -> None:
        self._env, drive = env, env.robot.drive
        turn = min(self._settings.max_yaw_rate or GENTLE_TURN, drive.max_yaw_rate)
        speed = min(self._settings.max_speed or math.inf, drive.max_speed)
        narrowest = drive.min_radius(env.robot.wheels)
        if self._radius < 2 * narrowest:
            text = f"a robot that turns in {narrowest:.2f} m at least needs a --radius of {2 * narrowest:.2f} m or more"
            raise ValueError(f"{text}, got {self._radius:g}")
        self._parts = parts_of(speed, turn, self._radius, narrowest, drive.max_linear_acceleration)
        self._brake = min(drive.max_linear_acceleration / 2, GENTLE_BRAKE)
        self.seconds = sum(part.seconds for part in self._parts)

    def start(self) -> tuple[float, float]:
        """Returns the goal of the drive, x and y, m: 1 mm beside the robot at rest, as a drive ends at its goal."""
        self._env.reset()
        x, y = self._env.rover_state.position[0, :2].tolist()
        return x + 1e-3, y

    def __call__(self, observation: TensorDictBase) -> TensorDictBase:
        if observation["outcome", "steps"].item() == 0:
            self._index, self._time, self._sign, self._blocked = 0, 0.0, 1.0, 0.0
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
