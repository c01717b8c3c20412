"""Reference implementation of the contract in plain Python, for one rover.

It transcribes the text of the contract and shares no code, constant or dependency with the package.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

DT = 0.05
LENGTH = 2000
LIDAR_POINTS = 32
MAX_LIDAR_RANGE = 12.0

KP, KI, KD, MAX_OUTPUT = 2.0, 0.0, 0.1, 7.0

SUCCESS_DISTANCE = 0.5
COLLISION_THRESHOLD = 0.3
COLLISION_WINDOW = 15
FLIP_THRESHOLD = 1.48
FLIP_GRACE = 500
STUCK_WINDOW = 600
STUCK_THRESHOLD = 0.001

GOAL_REWARD = 100.0
DISTANCE_DELTA_SCALE = 0.3
FINAL_REWARD_MULTIPLIER = 1.5
MIN_DELTA = 0.001
IDLE_PENALTY = -0.03
VELOCITY_BONUS = 0.0025
TURN_PENALTY = -0.0015
COLLISION_PENALTY = -0.5
STUCK_PENALTY = -25.0
GENERAL_PENALTY = -20.0
TOO_FAR_PENALTY = -10.0

COMPONENTS = ("goal", "progress", "velocity", "turn", "collision", "stuck", "general", "out_of_bounds")
EVENTS = ("flipped", "jammed", "out_of_bounds", "stuck", "goal_reached", "collision")

Pair = tuple[float, float]


@dataclass(frozen=True)
class WorldParameters:
    """One column of the contract's table of worlds: ``(low, high)`` pairs in meters."""

    rand_goal_x_range: Pair
    rand_goal_y_range: Pair
    rand_x_range: Pair
    rand_y_range: Pair
    too_far_away_x: Pair
    too_far_away_y: Pair


WORLDS = {
    "inspect": WorldParameters((-27, -19), (-27, -19), (-27, -19), (-27, -19), (-29, -13), (-29, -17)),
    "moon": WorldParameters((-4, 4), (-4, 4), (-4, 4), (-4, 4), (-20, 10), (-20, 20)),
    "maze": WorldParameters((-4, 4), (-4, 4), (-4, 4), (-4, 4), (-30, 30), (-30, 30)),
}


@dataclass(frozen=True)
class Reading:
    """Raw sensor values at one step: meters, radians, m/s, rad/s. ``dt`` is the time since the last step, s."""

    x: float
    y: float
    z: float
    roll: float
    pitch: float
    yaw: float
    ranges: Sequence[float]
    v: float
    w: float
    dt: float = DT


@dataclass(frozen=True)
class Step:
    """Expected result of one step.

    ``decided_by`` is ``flip``, ``jam``, ``out_of_bounds``, ``stuck``, ``goal``, ``collision`` or ``dense``.
    ``margin`` is the smaller distance of the distance reward's two conditions from their thresholds.
    """

    events: dict[str, bool]
    decided_by: str
    components: dict[str, float]
    reward: float
    progress: float
    alignment: float
    terminated: bool
    truncated: bool
    steps: int
    total_steps: int
    margin: float
    observation: dict[str, list[float]]


def normalize(angle: float) -> float:
    """``angle`` wrapped to [-pi, pi]."""
    return math.atan2(math.sin(angle), math.cos(angle))


def euler(quaternion: Sequence[float]) -> tuple[float, float, float]:
    """Roll, pitch and yaw about the fixed axes x, y and z ('sxyz') of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - x * z))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def clean(reading: float, max_range: float = MAX_LIDAR_RANGE) -> float:
    """A lidar reading clipped to [0, ``max_range``]; NaN becomes ``max_range``."""
    if math.isnan(reading):
        return max_range
    return min(max(reading, 0.0), max_range)


def pool(ranges: Sequence[float], points: int = LIDAR_POINTS, max_range: float = MAX_LIDAR_RANGE) -> list[float]:
    """The minimum of each of ``points`` segments of neighboring beams; the first ones hold one more beam if needed."""
    short, longer = divmod(len(ranges), points)
    pooled, first = [], 0
    for k in range(points):
        last = first + short + (1 if k < longer else 0)
        pooled.append(min(clean(reading, max_range) for reading in ranges[first:last]))
        first = last
    return pooled


def target_info(x: float, y: float, yaw: float, goal: Pair) -> Pair:
    """Distance (m) and relative angle (rad) of the goal."""
    distance = math.sqrt((goal[0] - x) ** 2 + (goal[1] - y) ** 2)
    return distance, normalize(math.atan2(goal[1] - y, goal[0] - x) - yaw)


def heading_alignment(angle: float) -> float:
    """Alignment of the heading with the goal: 1 straight ahead, 0 at a right angle, -1 behind."""
    return 1 - 2 * abs(angle) / math.pi


def is_flipped(roll: float, pitch: float) -> bool:
    return abs(roll) > FLIP_THRESHOLD or abs(pitch) > FLIP_THRESHOLD


class HeadingPid:
    """The contract's ``heading_controller``, with the derivative taken over the control step."""

    def __init__(self, kp: float = KP, ki: float = KI, kd: float = KD, max_output: float = MAX_OUTPUT) -> None:
        self.kp, self.ki, self.kd, self.max_output = kp, ki, kd, max_output
        self.reset()

    def reset(self) -> None:
        self.previous_error = 0.0
        self.integral = 0.0

    def __call__(self, desired: float, current: float, dt: float = DT) -> float:
        error = math.atan2(math.sin(desired - current), math.cos(desired - current))
        self.integral += error * dt
        derivative = (error - self.previous_error) / dt
        self.previous_error = error
        output = self.kp * error + self.ki * self.integral + self.kd * derivative
        return max(-self.max_output, min(self.max_output, output))


class ContractRover:
    """Computes the contract's observations, commands, rewards and endings of one rover from raw sensor values.

    ``bounds`` are those of the world, ``(too_far_away_x, too_far_away_y)``, ``length`` is the maximum number of steps
    of an episode, and ``stuck_window`` that of entries of the position history.
    """

    def __init__(
        self,
        bounds: tuple[Pair, Pair],
        length: int = LENGTH,
        stuck_window: int = STUCK_WINDOW,
        lidar_points: int = LIDAR_POINTS,
    ) -> None:
        self.bounds, self.length, self.stuck_window, self.lidar_points = bounds, length, stuck_window, lidar_points
        self.pid, self.total_steps = HeadingPid(), 0

    def reset(self, reading: Reading, goal: Pair) -> None:
        self._read(reading)
        self.goal = goal
        self.pid.reset()
        self.steps = 0
        self.collision_count = 0
        self.position_history: list[Pair] = []
        self.previous_distance = self.target(goal)[0]

    def _read(self, reading: Reading) -> None:
        self.reading = reading
        self.lidar = pool(reading.ranges, self.lidar_points)

    def target(self, goal: Pair) -> Pair:
        return target_info(self.reading.x, self.reading.y, self.reading.yaw, goal)

    def observation(self) -> dict[str, list[float]]:
        """The observation of the last reading, clipped to the observation space."""
        r = self.reading
        distance, angle = self.target(self.goal)
        limits = (30.0, 30.0, 10.0)
        return {
            "lidar": self.lidar,
            "pose": [max(-a, min(a, p)) for p, a in zip((r.x, r.y, r.z), limits, strict=True)],
            "imu": [r.pitch, r.roll, r.yaw],
            "target": [min(distance, 100.0), angle],
            "velocities": [max(-10.0, min(10.0, speed)) for speed in (r.v, r.w)],
        }

    def command(self, action: Sequence[float]) -> Pair:
        """Linear and angular velocity for an action. Call once per step, before :meth:`step`."""
        speed = max(-1.0, min(1.0, action[0]))
        offset = max(-math.pi, min(math.pi, action[1]))
        yaw = self.reading.yaw
        return speed, self.pid(yaw + offset, yaw, self.reading.dt)

    def step(self, reading: Reading, next_goal: Pair) -> Step:
        """Computes the result of a step from the readings after it. ``next_goal`` replaces a goal that is reached."""
        self._read(reading)
        self.steps += 1
        self.total_steps += 1
        self.position_history.append((reading.x, reading.y))
        if len(self.position_history) > self.stuck_window:
            self.position_history.pop(0)
        colliding = any(value < COLLISION_THRESHOLD for value in self.lidar)
        self.collision_count = self.collision_count + 1 if colliding else 0
        distance, angle = self.target(self.goal)

        events = {
            "flipped": is_flipped(reading.roll, reading.pitch),
            "jammed": self.collision_count > COLLISION_WINDOW,
            "out_of_bounds": self._too_far_away(),
            "stuck": self._stuck(),
        }
        ended = any(events.values())
        events["goal_reached"] = distance < SUCCESS_DISTANCE and not ended
        events["collision"] = colliding

        delta, alignment = self.previous_distance - distance, heading_alignment(angle)
        components = dict.fromkeys(COMPONENTS, 0.0)
        if events["flipped"]:
            decided_by = "flip"
            components["general"] = GENERAL_PENALTY if self.steps > FLIP_GRACE else 0.0
        elif events["jammed"]:
            decided_by = "jam"
            components["general"] = GENERAL_PENALTY
        elif events["out_of_bounds"]:
            decided_by = "out_of_bounds"
            components["out_of_bounds"] = TOO_FAR_PENALTY
        elif events["stuck"]:
            decided_by = "stuck"
            components["stuck"] = STUCK_PENALTY
        elif events["goal_reached"]:
            decided_by = "goal"
            components["goal"] = GOAL_REWARD
        elif colliding:
            decided_by = "collision"
            components["collision"] = COLLISION_PENALTY
        else:
            decided_by = "dense"
            paid = abs(delta) > MIN_DELTA and alignment > 0
            distance_reward = delta * DISTANCE_DELTA_SCALE if paid else IDLE_PENALTY
            components["progress"] = distance_reward * FINAL_REWARD_MULTIPLIER
            components["velocity"] = reading.v * VELOCITY_BONUS
            components["turn"] = abs(reading.w) * TURN_PENALTY

        if events["goal_reached"]:
            self.goal = next_goal
        self.previous_distance = self.target(self.goal)[0]
        return Step(
            events=events,
            decided_by=decided_by,
            components=components,
            reward=sum(components.values()),
            progress=delta,
            alignment=alignment,
            terminated=ended,
            truncated=not ended and self.steps >= self.length,
            steps=self.steps,
            total_steps=self.total_steps,
            margin=min(abs(abs(delta) - MIN_DELTA), abs(alignment)),
            observation=self.observation(),
        )

    def _too_far_away(self) -> bool:
        (x_low, x_high), (y_low, y_high) = self.bounds
        r = self.reading
        return r.x < x_low or r.x > x_high or r.y < y_low or r.y > y_high

    def _stuck(self) -> bool:
        if len(self.position_history) < self.stuck_window:
            return False
        (x_old, y_old), (x_new, y_new) = self.position_history[0], self.position_history[-1]
        return math.sqrt((x_new - x_old) ** 2 + (y_new - y_old) ** 2) < STUCK_THRESHOLD
