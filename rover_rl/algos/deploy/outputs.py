"""What a driver publishes beside its commands: its plan, its map, tracked movers and diagnostics."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from statistics import fmean
from threading import Event, Thread
from typing import Any

import numpy as np
import torch

from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.movers import movers_in_world
from rover_rl.envs.sensors.route import map_of
from rover_rl.envs.sensors.suite import MOVERS, ROUTE
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.poses import heading
from rover_rl.sims.ros2.simulator import Ros2Simulator
from rover_rl.sims.ros2.tf import MAP

PERIOD = 1.0  # time between two diagnostics, and two maps, s
CLOSE_TIMEOUT = 5.0  # longest time to wait at the end until all is published, s
COSTS = torch.tensor((100, 99, 66, 33, 0), dtype=torch.int8)  # of levels of a SeenMap; 100 and 99: closed, as in Nav2
UNKNOWN = torch.tensor(-1, dtype=torch.int8)  # cost of a cell of which nothing is known
HEIGHT, LIFETIME = 1.0, 500_000_000  # height of the marker of a mover, m, and time for which it is shown, ns
COLOR = ros.ColorRGBA(1.0, 0.5, 0.1, 0.8)
ARROW, CYLINDER = 0, 3  # types of a visualization_msgs/Marker
OK, WARN, ERROR = 0, 1, 2  # levels of a diagnostic_msgs/DiagnosticStatus

_log = logging.getLogger(__name__)


class DriveOutputs:
    """Publishes what a driver knows, in the frame of the rover's pose: see docs/ros2.md.

    What the policy of ``env``, a live rover's, does not have is not published. It looks for news once a command has
    been sent, while the rover waits for the next scan, and a thread publishes them, so that no decision waits.
    """

    def __init__(self, env: RoverEnv) -> None:
        assert isinstance(env.simulator, Ros2Simulator)
        self._env, self._rover, self._seen = env, env.simulator, map_of(env.observer)
        if self._seen is not None:
            self._seen.keep_paths()
        self._topics = topics = self._rover.settings
        kinds, readers = {topics.diagnostics_topic: ros.DiagnosticArray}, env.observer.readers
        kinds |= {} if self._seen is None else {topics.seen_map_topic: ros.OccupancyGrid}
        kinds |= {topics.plan_topic: ros.Path} if ROUTE in readers else {}
        kinds |= {topics.movers_topic: ros.MarkerArray} if MOVERS in readers else {}
        late, publisher = (topics.seen_map_topic, topics.plan_topic), self._rover.transport.publisher
        self._publish = {to: publisher(to, kind, latched=to in late) for to, kind in kinds.items()}
        self._is_open, self._wake = True, Event()
        self._pending: dict[str, Callable[[], Any]] = {}  # what makes the newest message of each topic
        self._last: dict[str, Any] = {}  # the last observation
        self._map_due, self._reported, self._latencies = 0.0, time.monotonic(), list[float]()
        self._counts = {topic: count for topic, (count, *_) in self._rover.arrivals().items()}
        self._thread, self._rover.on_command = Thread(target=self._run, daemon=True), self._take
        self._thread.start()

    def close(self) -> None:
        self._rover.on_command, self._is_open = lambda: None, False
        self._wake.set()
        self._thread.join(CLOSE_TIMEOUT)

    def _take(self) -> None:
        """Takes note of what the last decision was made on. What is held since an earlier one is the same tensor."""
        last, self._last = self._last, self._env.observer.inputs.observation
        entries, pending, topics, seen = self._last, self._pending, self._topics, self._seen
        stamp = ros.Time.from_seconds(self._env.rover_state.stamp.item())
        header, pose = ros.Header(stamp, self._rover.pose_frame or MAP), entries["pose"]
        self._latencies.append(self._rover.latency)
        if seen is not None and entries.get(ROUTE) is not last.get(ROUTE):
            points = torch.cat((pose[:, :2], seen.paths()[0])).unique_consecutive(dim=0)
            pending[topics.plan_topic] = partial(_path, header, points.tolist() if entries[ROUTE][0, -1] >= 0 else [])
        if entries.get(MOVERS) is not last.get(MOVERS):
            movers = movers_in_world(entries[MOVERS], pose, entries["imu"])[0]
            pending[topics.movers_topic] = lambda: _markers(header, movers.tolist(), pose[0, 2].item())
        if seen is not None and time.monotonic() >= self._map_due:
            self._map_due, (levels, corner), cell = time.monotonic() + PERIOD, seen.levels(), seen.cell.item()
            costs = torch.where(seen.known(), COSTS[levels.long()], UNKNOWN)[0].numpy()
            pending[topics.seen_map_topic] = partial(_grid, header, costs, corner[0].tolist(), cell)
        self._wake.set()

    def _run(self) -> None:
        due, is_open = time.monotonic() + PERIOD, True
        while is_open:
            self._wake.wait(max(0.0, due - time.monotonic()))
            self._wake.clear()
            # The last ones follow the end of a drive.
            is_open = self._is_open
            if not is_open or time.monotonic() >= due:
                due = time.monotonic() + PERIOD
                self._pending[self._topics.diagnostics_topic] = self._diagnostics
            while self._pending:
                topic, make = self._pending.popitem()
                try:
                    self._publish[topic](make())
                except Exception:  # whatever it is, the drive goes on
                    _log.exception("%s: a message is not published", topic)

    def _diagnostics(self) -> Any:
        elapsed, self._reported = time.monotonic() - self._reported, time.monotonic()
        latencies, self._latencies = self._latencies, []
        times = {"decision_time": fmean(latencies), "longest_decision_time": max(latencies)} if latencies else {}
        shown = {name: f"{1000 * seconds:.1f} ms" for name, seconds in times.items()}
        level, message = self._state(is_driving=bool(latencies))
        found = [self._status("drive", level, message, **shown)]
        for topic, (count, age, silence) in self._rover.arrivals().items():
            rate = f"{(count - self._counts.get(topic, 0)) / elapsed:.1f} Hz"
            self._counts[topic] = count
            level, message = (ERROR, silence) if silence else (OK, rate)
            found.append(self._status(topic, level, message, rate=rate, age=f"{age:.3f} s"))
        return ros.DiagnosticArray(ros.Header(ros.Time.from_seconds(time.time())), found)

    def _state(self, is_driving: bool) -> tuple[int, str]:
        rover, brake = self._rover, self._env.brake
        states = (
            (not rover.robot_connected, ERROR, "stopped: no usable scan arrives"),
            (rover.gives_way, WARN, "gives way to another node"),
            (not is_driving, OK, "waits"),
            (rover.held, WARN, "held: no beam covers the direction of travel"),
            (brake is not None and brake.acts, WARN, "the guard brakes before what is in the way"),
        )
        return next(((level, message) for holds, level, message in states if holds), (OK, "drives"))

    def _status(self, name: str, level: int, message: str, **values: str) -> Any:
        name, pairs = f"{self._topics.node.strip('/')}: {name}", [ros.KeyValue(*pair) for pair in values.items()]
        return ros.DiagnosticStatus(level, name, message, values=pairs)


def _path(header: Any, points: list[list[float]]) -> Any:
    """Returns the path along points, x and y (m), each with the heading of the way to the next."""
    yaws = [math.atan2(y - b, x - a) for (a, b), (x, y) in pairwise(points)]
    places = zip(points, [*yaws, *(yaws[-1:] or [0.0])], strict=False)
    poses = [ros.Pose(ros.Point(*point), ros.Quaternion(*heading(yaw))) for point, yaw in places]
    return ros.Path(header, [ros.PoseStamped(header, pose) for pose in poses])


def _grid(header: Any, costs: np.ndarray, corner: list[float], cell: float) -> Any:
    about = ros.MapMetaData(header.stamp, cell, *costs.shape, ros.Pose(ros.Point(*corner)))
    return ros.OccupancyGrid(header, about, costs.ravel())


def _markers(header: Any, movers: list[list[float]], ground: float) -> Any:
    """Returns the markers of movers: x, y (m), their velocities (m/s) and radius (m); 0 without one."""
    shown, z = list[Any](), ground + HEIGHT / 2
    for number, (x, y, speed_x, speed_y, radius) in enumerate(movers):
        if radius > 0:
            same = {"id": number, "color": COLOR, "lifetime": ros.Duration(0, LIFETIME)}
            place, size = ros.Pose(ros.Point(x, y, z)), ros.Vector3(2 * radius, 2 * radius, HEIGHT)
            shown.append(ros.Marker(header, "movers", type=CYLINDER, pose=place, scale=size, **same))
            ends, size = [ros.Point(x, y, z), ros.Point(x + speed_x, y + speed_y, z)], ros.Vector3(0.05, 0.1)
            shown.append(ros.Marker(header, "velocities", type=ARROW, points=ends, scale=size, **same))
    return ros.MarkerArray(shown)
