"""
Your own robot
==============

A robot is a URDF, a drive and sensors. This script describes a small rover from scratch, looks at it, and compares how
it and the package's rover turn and drive.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDictBase

from rover_rl import make_env
from rover_rl.robots import Robot, get_robot
from rover_rl.robots.drives import SkidSteer

# %%
# The URDF
# --------
# A chassis of one box, four wheels, each on a continuous joint about +y, and a link where the lidar is. A URDF of your
# own is a file already; one in xacro is expanded first (``xacro robot.urdf.xacro > robot.urdf``).

RADIUS, WIDTH = 0.1, 0.05
HUBS = {
    "front_left": (0.13, 0.19),
    "rear_left": (-0.13, 0.19),
    "front_right": (0.13, -0.19),
    "rear_right": (-0.13, -0.19),
}
CHASSIS = '<origin xyz="0 0 0.17"/><geometry><box size="0.42 0.3 0.16"/></geometry>'
WHEEL = f'<origin rpy="1.5707963267948966 0 0"/><geometry><cylinder radius="{RADIUS}" length="{WIDTH}"/></geometry>'
wheels = "".join(
    f"""
    <link name="{name}_link">
      <inertial><mass value="0.6"/><inertia ixx="0.0016" ixy="0" ixz="0" iyy="0.003" iyz="0" izz="0.0016"/></inertial>
      <visual>{WHEEL}<material name="rubber"><color rgba="0.12 0.12 0.13 1"/></material></visual>
      <collision>{WHEEL}</collision>
    </link>
    <joint name="{name}" type="continuous">
      <parent link="base_link"/><child link="{name}_link"/>
      <origin xyz="{x} {y} {RADIUS}"/><axis xyz="0 1 0"/>
    </joint>"""
    for name, (x, y) in HUBS.items()
)
urdf = Path(tempfile.mkdtemp()) / "scout.urdf"
urdf.write_text(
    f"""<robot name="scout">
    <link name="base_link">
      <inertial><origin xyz="0 0 0.15"/><mass value="9.0"/>
        <inertia ixx="0.09" ixy="0" ixz="0" iyy="0.15" iyz="0" izz="0.2"/></inertial>
      <visual>{CHASSIS}<material name="paint"><color rgba="0.15 0.45 0.75 1"/></material></visual>
      <collision>{CHASSIS}</collision>
    </link>{wheels}
    <link name="lidar_link"/>
    <joint name="lidar" type="fixed">
      <parent link="base_link"/><child link="lidar_link"/><origin xyz="0.1 0 0.24"/>
    </joint>
    </robot>"""
)

# %%
# The drive
# ---------
# Wheels, masses and mounts come from the URDF. The drive names the joints and states what the URDF does not: the
# torque, the limits, and for a skid-steer robot the effective ``separation`` of its sides, which is wider than the
# geometric one because the wheels slip in turns. A joint that the URDF does not have, or a wheel on the wrong side, is
# refused.

scout = Robot.from_urdf(
    urdf,
    drive=SkidSteer(
        left=("front_left", "rear_left"),
        right=("front_right", "rear_right"),
        separation=0.55,
        torque=4.0,
        max_linear_acceleration=2.0,
    ),
    imu=(0.0, 0.0, 0.2),
    lidar_range=10.0,
)

# %%
# How it drives
# -------------
# Both robots drive ahead, with the heading held 30 degrees to the left of the current one. The package's rover turns
# more slowly: it slips, and its drive assumes a track of 0.24 m, as that of the original environment does.

STEPS = 60  # of 0.05 s
START, GOAL = torch.tensor([[0.0, 0.0, 0.0]]), torch.tensor([[3.5, 3.5]])


def turn_left(td: TensorDictBase) -> TensorDictBase:
    return td.set("action", torch.tensor([[1.0, math.radians(30)]]))


figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), layout="constrained", width_ratios=(1, 1.2))
for robot in (scout, get_robot("rover_zero")):
    env = make_env(world_n="ramps@0", robot=robot, num_envs=1, seed=0, backend="warp")
    env.reset(start=START, goal=GOAL)
    if robot is scout:
        right.imshow(env.base_env.render(view="chase", width=640, height=480).numpy())
        right.set_axis_off()
    state = env.reset(start=START, goal=GOAL)
    drive = env.rollout(STEPS, turn_left, auto_reset=False, tensordict=state)
    path = drive["pose"][0, :, :2]
    yaw_rate = torch.diff(drive["imu"][0, :, 2]).remainder(2 * math.pi).median().item() / env.base_env.control_dt
    speed = drive["velocities"][0, -1, 0]
    print(f"{robot.name}: {speed:.2f} m/s, turns at {math.degrees(yaw_rate):.0f} degrees per second")
    left.plot(*path.T, ".-", label=robot.name)
    env.close()
left.set(title="paths of three seconds", xlabel="x (m)", ylabel="y (m)", aspect="equal")
left.legend()
plt.show()

# %%
# In training
# -----------
# ``make_env(robot=scout)`` takes the object. On the command line, a module that defines it has a name:
# ``rover-rl train --world moon --robot my_package:scout``. The checkpoint holds it, and a policy for another robot is
# refused.
