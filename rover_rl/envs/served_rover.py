"""``ServedRover``: one simulated rover as its sensors tell it, for a node that publishes it on ROS 2.

Example:
    >>> rover = ServedRover(EnvConfig(world="plaza:10001", backend="warp", seed=0))
    >>> rover.reset((0.0, 0.0, 0.0))
    >>> rover.step((0.5, 0.0)).state.position.shape
    torch.Size([1, 3])
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch

from rover_rl.checks import MAX_COUNT
from rover_rl.envs.config import SCAN_POSE, EnvConfig, PoseConfig, Randomization, SensorLike, TaskConfig
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.cameras import ColorCamera, DepthCamera, Lidar3D
from rover_rl.envs.sensors.heights import HeightScan
from rover_rl.envs.sensors.suite import own_sensors
from rover_rl.rotations import quaternion_product, quaternion_to_euler
from rover_rl.sims.movers.field import shown_parts
from rover_rl.sims.movers.standing import check_standing
from rover_rl.sims.rover_state import RoverState
from rover_rl.sims.sensor_report import Device, DeviceKind, ElevationMap, SensorReport, Variances

MAP_CELL = 0.1
"""Side of a cell of an elevation map, m."""


class ServedRover:
    """A rover among the movers of its world, with the noise, delays and errors of an environment.

    What it reports has the stamp of its time, however late it arrives. Lost scans never arrive. The commands are
    limited to what the robot's drive can do, or to ``config.limits``, as the base of a real rover limits them. Of the
    lidar of ``config``, the number of beams counts: it scans in each step, or as ``randomization.scan_period`` says. Of
    the sensors, it has depth and color cameras and 3D lidars, and for height scans elevation maps without errors.
    """

    def __init__(self, config: EnvConfig) -> None:
        lidar = replace(config.lidar, points=min(config.lidar.points, config.lidar.beams), period=1)
        one: dict[str, Any] = {"num_envs": 1, "agents": 1, "length": MAX_COUNT, "end_on_goal": False}
        plain: dict[str, Any] = {"task": TaskConfig(), "limits": replace(config.limits, apply=True, min_reversal=0.0)}
        plain["randomization"] = replace(config.randomization, limits=(1.0, 1.0))
        plain |= {"privileged": False, "compensate_delay": False}
        sensors = own_sensors(config.sensors).values()

        def of(kind: type[Any]) -> list[Any]:
            return [sensor for sensor in sensors if isinstance(sensor, kind)]

        self._depth, self._colors, self._lidars, self._heights = map(
            of, (DepthCamera, ColorCamera, Lidar3D, HeightScan)
        )
        self._rays = [torch.tensor(sensor.rays()[0]) for sensor in self._lidars]
        served: tuple[SensorLike, ...] = (SCAN_POSE, *self._depth, *self._colors, *self._lidars)
        self.env = RoverEnv(replace(config, **one, **plain, lidar=lidar, sensors=served))
        self.control_dt, self.robot = self.env.control_dt, self.env.robot
        kinds: dict[DeviceKind, list[Any]] = {"depth": self._depth, "colors": self._colors, "points": self._lidars}
        self.devices = tuple(_device(kind, each) for kind, some in kinds.items() for each in some)
        self._scan_stamp = torch.zeros(1, 1, dtype=torch.float64)
        self._arrived = -1.0

    def reset(self, pose: tuple[float, float, float]) -> None:
        """Moves the rover to a pose: x, y (m) and yaw (rad), at rest, and draws its delays and errors anew."""
        steps = self.env.reset(start=torch.tensor([pose]))["outcome", "steps"]
        self._report(steps)

    def move_to(self, pose: tuple[float, float, float]) -> None:
        """Does the same as :meth:`reset`; raises ``ValueError`` if the rover cannot stand there, and leaves it.

        It cannot off the terrain, in an obstacle, or where something that moves begins.
        """
        env = self.env
        check_standing(env.worlds[0], env.robot, pose)
        state = env.rover_state
        x, y, yaw = (*state.position[0, :2].tolist(), quaternion_to_euler(state.orientation)[0, 2].item())
        self.reset(pose)
        try:
            check_standing(env.worlds[0], env.robot, pose, shown_parts(env.movers, 0))
        except ValueError:
            self.reset((x, y, yaw))
            raise

    def step(self, command: tuple[float, float]) -> SensorReport:
        """Takes a step with a command, m/s and rad/s, and returns what arrives from the sensors after it."""
        observation = self.env.step_commands(torch.tensor([command]))
        report = self._report(observation["outcome", "steps"])
        is_new, self._arrived = report.scan_stamp != self._arrived, report.scan_stamp
        depth = {one.topic: observation[one.name].unflatten(-1, one.size)[0] for one in self._depth}
        colors = {one.topic: observation[one.name].unflatten(-1, (3, *one.size))[0] for one in self._colors}
        clouds = zip(self._lidars, self._rays, strict=True)
        points = {one.topic: _points(one, rays, observation[one.name][0]) for one, rays in clouds}
        ground = {scan.topic: self._map(scan, report.state.position[0]) for scan in self._heights}
        report = report._replace(images={"depth": depth, "colors": colors}, points=points, ground=ground)
        return report if is_new else report._replace(ranges=None)

    def close(self) -> None:
        self.env.close()

    def _map(self, scan: HeightScan, position: torch.Tensor) -> ElevationMap:
        reach = math.hypot(scan.ahead + scan.spacing * scan.size[0] / 2, scan.spacing * scan.size[1] / 2)
        count = math.ceil(reach / MAP_CELL) + 1
        # Cells stay where they are when the map moves.
        x, y = (position[:2] / MAP_CELL).round().mul(MAP_CELL).tolist()
        along = MAP_CELL * torch.arange(count, -count - 1, -1, dtype=torch.float64)
        points = torch.stack(torch.meshgrid(x + along, y + along, indexing="ij"), -1)
        return ElevationMap(self.env.worlds[0].height_at(points).float(), (x, y), MAP_CELL, scan.layer)

    def _report(self, steps: torch.Tensor) -> SensorReport:
        env, delays = self.env, self.env.delays
        assert delays is not None
        sensed, pose, stamp = env.state.sensed.rover, env.state.pose, env.rover_state.stamp
        # The IMU of a live rover has the heading of the pose.
        half = (pose.yaw - env.state.sensed.yaw) / 2
        turn = torch.cat((torch.zeros(1, 2), half.sin(), half.cos()), -1)
        told = {
            "position": pose.position,
            "orientation": quaternion_product(turn, sensed.orientation),
            "linear_velocity": sensed.linear_velocity,
            "angular_velocity": sensed.angular_velocity,
            "stamp": stamp,
        }
        late = {name: delays.late(f"told {name}", value, steps, delays.state) for name, value in told.items()}
        self._scan_stamp = torch.where(delays.scan_step == steps, stamp, self._scan_stamp)
        scan_stamp = delays.late("told scan stamp", self._scan_stamp, steps, delays.scan)
        ranges = delays.late("told scan", env.state.sensed.ranges, steps, delays.scan)
        state, config = RoverState.pack(**late, dt=sensed.dt), env.config
        variances = _variances(config.randomization, config.pose, env.control_dt, int(steps))
        return SensorReport(stamp.item(), state, ranges[0], scan_stamp.item(), variances=variances)


def _variances(noise: Randomization, pose: PoseConfig, dt: float, steps: int) -> Variances:
    """Returns the mean squares of the errors over all that a reset can draw, some steps of ``dt`` (s) after it."""
    severity, bias = _mean_square(*noise.severity), _mean_square(*noise.yaw_bias)
    tilt, drift, jump = (severity * each**2 for each in (noise.imu_noise, pose.drift_heading, pose.jump_heading))
    localized = {"either": 0.5, "localized": 1.0}.get(pose.source, 0.0)
    reckoned = 0.0 if pose.source == "truth" else 1 - localized
    # The error of the heading, and its change in a step: see rover_rl.envs.stages.Localization.
    error = reckoned * bias * (steps * dt) ** 2 + localized * (drift + jump)
    moved = drift * (1 - math.exp(-dt / pose.drift_time)) + jump * (1 - math.exp(-pose.jump_rate * dt))
    rate = (2 * tilt + 2 * localized * moved) / dt**2 + reckoned * bias
    scale = _mean_square(*(end - 1 for end in noise.odometry_scale))
    return Variances(tilt, tilt + error, rate, severity * noise.odometry_noise**2, scale)


def _mean_square(low: float, high: float) -> float:
    """Returns the mean square of numbers that are drawn uniformly from a range."""
    return (low * low + low * high + high * high) / 3


def _device(kind: DeviceKind, sensor: Any) -> Device:
    pitch, focal = (sensor.pitch, sensor.focal_length) if kind != "points" else (0.0, 0.0)
    return Device(kind, sensor.name, sensor.topic, sensor.mount, sensor.yaw, pitch, sensor.size, focal)


def _points(lidar: Lidar3D, rays: torch.Tensor, ranges: torch.Tensor) -> torch.Tensor:
    """Returns the points of a 3D lidar in its frame, ``[planes, beams, 3]``, m; NaN for no return and lost ones."""
    seen = (ranges > 0) & (ranges < lidar.max_range)
    return (rays * ranges.masked_fill(~seen, math.nan)[:, None]).unflatten(0, lidar.size)
