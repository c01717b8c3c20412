"""
What a depth camera sees
========================

A planar lidar looks over boulders and into the sky beyond a crater. A depth camera sees them, and a height scan has the
ground around the robot. This script draws both, on the moon.
"""

from __future__ import annotations

import math

import matplotlib.pyplot as plt
import torch

from rover_rl import make_env
from rover_rl.envs.sensors.heights import HeightScan
from rover_rl.envs.sensors.ray_images import DepthCamera

# %%
# Two sensors
# -----------
# Sensors are given to the environment. Each adds an entry to the observation, named as it is. The readings of the
# camera are depths in m along its optical axis, row by row from the top left.

camera = DepthCamera(size=(72, 96), field_of_view=math.radians(80), noise=0.005)
heights = HeightScan(size=(32, 32), spacing=0.1, ahead=1.2)
env = make_env(world="moon", num_envs=1, seed=0, backend="warp", sensors=[camera, heights])
observation = env.reset(start=torch.tensor([[0.5, -2.5, 2.0]]), goal=torch.tensor([[-3.0, 2.0]]))
depth = observation["depth"][0].unflatten(-1, camera.size)
ground = observation["heights"][0].unflatten(-1, heights.size)
env.close()

# %%
# What they read
# --------------

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
shown = left.imshow(depth.numpy(), cmap="viridis_r")
figure.colorbar(shown, ax=left, label="depth, m")
left.set(title="depth camera", xticks=[], yticks=[])
half = heights.spacing * heights.size[1] / 2
far, near = heights.ahead + half, heights.ahead - half
shown = right.imshow(ground.numpy(), cmap="terrain", extent=(half, -half, near, far))
figure.colorbar(shown, ax=right, label="height relative to the robot, m")
right.plot(0, 0, "r^")
right.set(title="height scan, the robot in red", xlabel="to the left, m", ylabel="ahead, m")
plt.show()
