"""
What cameras see
================

A planar lidar looks over boulders and into the sky beyond a crater. Cameras see them, and a height scan has the ground
around the robot. This script draws four sensors at the same moment, among people who walk on the moon.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import torch

from rover_rl import make_env
from rover_rl.envs.sensors.cameras import ColorCamera, DepthCamera, Seen, SegmentationCamera
from rover_rl.envs.sensors.heights import HeightScan

# %%
# Four sensors
# ------------
# Sensors are given to the environment. Each adds an entry to the observation, named as it is. An image is read row by
# row from the top left, and a color image has red, green and blue one after another.

size = (120, 160)
sensors = [ColorCamera(size=size), DepthCamera(size=size, noise=0.005), SegmentationCamera(size=size)]
heights = HeightScan(size=(32, 32), spacing=0.1, ahead=1.2)
env = make_env(world="moon+walkers:3@1", num_envs=1, seed=0, backend="warp", sensors=[*sensors, heights])
observation = env.reset(start=torch.tensor([[0.5, -2.5, 2.0]]), goal=torch.tensor([[-1.2, 0.6]]))
images = {camera.name: observation[camera.name][0].unflatten(-1, (-1, *size)) for camera in sensors}
ground = observation["heights"][0].unflatten(-1, heights.size)
env.close()

# %%
# What they read
# --------------

figure, axes = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
(colors, depth), (kinds, scan) = axes
colors.imshow(images["colors"].movedim(0, -1).numpy())
shown = depth.imshow(images["depth"][0].numpy(), cmap="viridis_r")
figure.colorbar(shown, ax=depth, label="depth, m")
shown = kinds.imshow(images["segmentation"][0].numpy(), cmap=plt.get_cmap("Set2", len(Seen)), vmin=-0.5, vmax=4.5)
figure.colorbar(shown, ax=kinds, ticks=range(len(Seen))).ax.set_yticklabels([kind.name.lower() for kind in Seen])
for ax, camera in zip((colors, depth, kinds), sensors, strict=True):
    ax.set(title=camera.name, xticks=[], yticks=[])
half = heights.spacing * heights.size[1] / 2
far, near = heights.ahead + half, heights.ahead - half
shown = scan.imshow(ground.numpy(), cmap="terrain", extent=(half, -half, near, far))
figure.colorbar(shown, ax=scan, label="height relative to the robot, m")
scan.plot(0, 0, "r^")
scan.set(title="heights, the robot in red", xlabel="to the left, m", ylabel="ahead, m")
plt.show()
