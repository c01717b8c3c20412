"""The command ``rover-rl calibrate``."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, ClassVar

import tyro

from rover_rl.cli.help_text import FLAT
from rover_rl.cli.options import Force, OptionsOfRobot
from rover_rl.files import check_outputs
from rover_rl.robots.options import RobotOptions, with_options
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.settings import Connection


@dataclass(frozen=True)
class Calibrate:
    """Find delays, limits, lag, scales and noise of a robot from a recorded drive, with intervals.

    Writes calibration.yaml, which train --config, evaluate --env and robot --env take, and calibration.png.
    """

    shown: ClassVar = {
        Connection: {"cmd_vel_topic", "imu_topic", "scan_topic"},
        Ros2Settings: {"odometry_topic", "pose_topic"},
    }

    bag: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="BAG")]
    """Recording: an MCAP file or a folder of rosbag2, with commands and wheel odometry, and IMU, pose and scan if there
    are any (needs the extra ros2)."""
    robot: str = "rover_zero"
    """Robot whose limits and track count before the calibration: a name, a URDF file, or module:attribute."""
    robot_options: OptionsOfRobot = field(default_factory=RobotOptions)
    connection: Annotated[Connection, FLAT] = field(default_factory=Connection)
    settings: Annotated[Ros2Settings, FLAT] = field(default_factory=Ros2Settings)
    out: Path = Path("runs/calibration")
    """Folder to write to."""
    force: Force = False

    def __call__(self) -> int:
        outputs = self.out / "calibration.yaml", self.out / "calibration.png"
        check_outputs(*outputs, inputs=[str(self.bag)], force=self.force)
        from rover_rl.algos.calibration.calibrate import calibrate
        from rover_rl.algos.calibration.reading import read_recording
        from rover_rl.algos.calibration.report import describe, draw, env_settings, write_settings
        from rover_rl.native.threads import single_threaded
        from rover_rl.robots import get_robot

        name = with_options(self.robot, self.robot_options)
        robot = get_robot(name)
        recording = read_recording(self.bag, self.connection, self.settings)
        with single_threaded():
            calibration = calibrate(recording, robot)
        lines = describe(calibration)
        print("\n".join(lines))
        write_settings(env_settings(calibration, name, robot), lines, outputs[0])
        draw(calibration, outputs[1])
        print(f"settings: {outputs[0]}; picture: {outputs[1]}")
        return 0
