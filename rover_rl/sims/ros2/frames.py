"""What other tools know of a simulated robot and its world: tf, its shape, its cameras and a map.

The frames, from parent to child, are::

    map -> world -> odom -> base_link -> lidar_link, imu_link, NAME_link, NAME_link -> NAME_optical_frame

``NAME`` is that of a camera or a 3D lidar. ``world`` is ``map``: the frame of the poses. Wheel odometry tells where
``base_link`` is in ``odom``, and a localizer, which errs as the robot's pose does, where ``odom`` is in ``world``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.robots import Robot
from rover_rl.robots.shapes import Frame, Shape
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.tf import Transform
from rover_rl.sims.sensor_report import Device, DeviceKind
from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.world import World

MAP, WORLD, ODOM, BASE, LIDAR, IMU = "map", "world", "odom", "base_link", "lidar_link", "imu_link"
MAP_CELL = 0.05  # side of a cell of the map, m
OCCUPIED = 100  # what an occupied cell of a ``nav_msgs/OccupancyGrid`` has; a free one has 0
OPTICAL = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])
"""Axes of an image in those of its camera: to the right, down and ahead (REP 103)."""
GRAY = (0.5, 0.5, 0.5)


class RobotFrames:
    """Frames of a robot and of its sensors: of the lidar, turned by ``lidar_yaw`` (rad), the IMU and the ``devices``.

    If it ``is_localized``, they tell where ``odom`` is in ``world``. Else, another node tells where it is in ``map``.
    """

    def __init__(
        self, robot: Robot, devices: Iterable[Device] = (), lidar_yaw: float = 0.0, is_localized: bool = True
    ) -> None:
        self._robot, self._lidar_yaw, self._is_localized = robot, lidar_yaw, is_localized
        self._devices = {(device.kind, device.topic): device for device in devices}
        self._last = -math.inf

    def fixed(self) -> Any:
        """Returns the transforms that never change, a ``tf2_msgs/TFMessage``."""
        turned = Rotation.from_euler("z", self._lidar_yaw)
        found = [Transform(BASE, LIDAR, np.array(self._robot.lidar_position), turned)]
        found += [Transform(BASE, IMU, np.array(self._robot.imu_position), Rotation.identity())]
        for device in self._devices.values():
            link, ahead = f"{device.name}_link", Rotation.from_euler("ZY", (device.yaw, device.pitch))
            found.append(Transform(BASE, link, np.array(device.mount), ahead))
            if device.kind != "points":
                found.append(Transform(link, _frame(device), np.zeros(3), OPTICAL))
        if self._is_localized:
            found.append(Transform(MAP, WORLD, np.zeros(3), Rotation.identity()))
        return ros.TFMessage([each.message(ros.Time()) for each in found])

    def moving(self, stamp: Any, pose: Any, odometry: Any) -> Any | None:
        """Returns the transforms at a stamp, or ``None`` if it is not later than the last one, as tf wants it.

        ``pose`` is that of the robot in ``world`` and ``odometry`` that in ``odom``, a ``geometry_msgs/Pose`` each.
        """
        if ros.seconds_of(stamp) <= self._last:
            return None
        self._last = ros.seconds_of(stamp)
        base = Transform(ODOM, BASE, *_read(odometry))
        found = [base]
        if self._is_localized:
            # world -> base_link = world -> odom * odom -> base_link
            position, rotation = _read(pose)
            turn = rotation * base.rotation.inv()
            found.append(Transform(WORLD, ODOM, position - turn.apply(base.position), turn))
        return ros.TFMessage([each.message(stamp) for each in found])

    def frame_of(self, kind: DeviceKind, topic: str | None) -> str:
        """Returns the frame of what a camera or a 3D lidar tells, by its topic, or ``None`` for the connection's."""
        return _frame(self._devices[kind, topic])

    def camera_info(self, kind: DeviceKind, topic: str | None, stamp: Any) -> Any:
        """Returns what a camera is, a ``sensor_msgs/CameraInfo``: one without distortion."""
        camera = self._devices[kind, topic]
        (rows, columns), focal = camera.size, camera.focal_length
        x, y = (columns - 1) / 2, (rows - 1) / 2
        return ros.CameraInfo(
            ros.Header(stamp, _frame(camera)),
            height=rows,
            width=columns,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=np.array([focal, 0, x, 0, focal, y, 0, 0, 1.0]),
            r=np.eye(3).ravel(),
            p=np.array([focal, 0, x, 0, 0, focal, y, 0, 0, 0, 1.0, 0]),
        )

    def description(self) -> Any:
        """Returns a URDF, a ``std_msgs/String``: one link with the visual shapes of the robot, its joints at zero."""
        boxes = (Shape("box", Frame(np.array(box.center), np.eye(3)), box.size) for box in self._robot.boxes)
        shapes = self._robot.visuals or [*boxes]
        link = f'<link name="{BASE}">{"".join(map(_visual, shapes))}</link>'
        return ros.String(f"<robot name={quoteattr(self._robot.name)}>{link}</robot>")


def info_topic(image_topic: str) -> str:
    """Returns the topic of the ``sensor_msgs/CameraInfo`` of an image: beside it, as in image_transport."""
    raw = image_topic.removesuffix("/compressed").removesuffix("/compressedDepth")
    return f"{raw.rpartition('/')[0]}/camera_info"


def world_map(world: World) -> Any:
    """Returns the obstacles of a world, a ``nav_msgs/OccupancyGrid`` with cells of 5 cm: 100 occupied, 0 free."""
    (x_low, x_high), (y_low, y_high) = world.terrain.extent
    xs, ys = (
        low + MAP_CELL * (np.arange(max(1, math.floor((high - low) / MAP_CELL + 1e-6))) + 0.5)
        for low, high in ((x_low, x_high), (y_low, y_high))
    )
    reach = MAP_CELL / math.sqrt(2)
    occupied = clearance_on_grid(world.terrain, world.obstacles, xs, ys, 2 * reach).numpy() < reach
    corner = ros.Pose(ros.Point(float(xs[0] - MAP_CELL / 2), float(ys[0] - MAP_CELL / 2)))
    about = ros.MapMetaData(resolution=MAP_CELL, width=len(xs), height=len(ys), origin=corner)
    return ros.OccupancyGrid(ros.Header(frame_id=MAP), about, np.where(occupied, OCCUPIED, 0).astype(np.int8).ravel())


def _read(pose: Any) -> tuple[np.ndarray, Rotation]:
    place, turn = pose.position, pose.orientation
    return np.array([place.x, place.y, place.z]), Rotation.from_quat([turn.x, turn.y, turn.z, turn.w])


def _frame(device: Device) -> str:
    return f"{device.name}_link" if device.kind == "points" else f"{device.name}_optical_frame"


def _visual(shape: Shape) -> str:
    angles = Rotation.from_matrix(shape.frame.rotation).as_euler("xyz")
    place = f'<origin xyz="{_text(shape.frame.position)}" rpy="{_text(angles)}"/>'
    if shape.kind == "cylinder":
        radius, length = shape.sizes
        sizes = f'radius="{radius:g}" length="{length:g}"'
    elif shape.kind == "mesh":
        sizes = f'filename={quoteattr(shape.file)} scale="{_text(shape.sizes)}"'
    else:
        sizes = f'{"radius" if shape.kind == "sphere" else "size"}="{_text(shape.sizes)}"'
    color = f'<material name=""><color rgba="{_text(shape.color or GRAY)} 1"/></material>'
    return f"<visual>{place}<geometry><{shape.kind} {sizes}/></geometry>{color}</visual>"


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
