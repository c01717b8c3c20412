"""Topics and timeout of the connection to a live rover."""

from __future__ import annotations

from dataclasses import dataclass

from rover_rl.checks import check_topics
from rover_rl.plain import take_numbers


@dataclass(frozen=True)
class Connection:
    """Topics and timeout of the connection to a live rover, as in the original environment's arguments.

    Simulators that generate their own sensor data ignore it.

    Args:
        scan_topic: Topic of the ``sensor_msgs/LaserScan``.
        imu_topic: Topic of the ``sensor_msgs/Imu``.
        cmd_vel_topic: Topic of the command, a ``geometry_msgs/Twist``.
        camera_topic: Topic of the depth image, a ``sensor_msgs/Image``, or a ``sensor_msgs/CompressedImage`` if it ends
            in ``/compressed`` or ``/compressedDepth``. It is received if a sensor asks for it.
        color_topic: Topic of the color image, likewise.
        timeout: Time to wait for the first scan, s.
        elevation_topic: Topic of the ground, a ``grid_map_msgs/GridMap`` or ``sensor_msgs/PointCloud2``, which is
            received if a sensor asks for it.
        points_topic: Topic of the 3D lidar, a ``sensor_msgs/PointCloud2``, which is received if a sensor asks for it.
        joint_topic: Topic of the motor torques, a ``sensor_msgs/JointState``, likewise.
        contact_topic: Topic of the contacts, a ``ros_gz_interfaces/Contacts``. ``None``: contacts are not received, and
            a sensor that asks for them is refused, since silence means that there is none.

    Raises:
        ValueError: if a topic is not allowed in ROS 2.
    """

    scan_topic: str = "/scan"
    imu_topic: str = "/imu/data"
    cmd_vel_topic: str = "/cmd_vel"
    camera_topic: str = "/camera/image_raw"
    color_topic: str = "/camera/color/image_raw"
    timeout: float = 30.0
    elevation_topic: str = "/elevation_map"
    points_topic: str = "/points"
    joint_topic: str = "/joint_states"
    contact_topic: str | None = None

    def __post_init__(self) -> None:
        take_numbers(self)
        topics = {name: topic for name, topic in vars(self).items() if name.endswith("_topic")}
        check_topics(**{name: topic for name, topic in topics.items() if (name, topic) != ("contact_topic", None)})

    @property
    def image_topics(self) -> dict[str, str]:
        """Topics of the images, by what they show."""
        return {"depth": self.camera_topic, "colors": self.color_topic}
