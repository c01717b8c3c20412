"""
What the lidar sees
===================

The observation holds 32 readings, each the nearest of a segment of the 128 beams of a scan. This script draws both, in
the maze, and what happens with fewer beams and with sensor noise.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes

from rover_rl import EnvConfig, LidarConfig, Randomization, make_env
from rover_rl.robots import get_robot
from rover_rl.worlds import get_world
from rover_rl.worlds.draw import draw_map

MOUNT = get_robot("rover_zero").lidar_position[0]  # the lidar is 0.17 m ahead of the center of the rover

# %%
# One scan
# --------
# ``env.base_env.rover_state`` is the true state with the raw scan, ``observation["lidar"]`` what a policy gets.


def draw_scan(axes: Axes, config: EnvConfig) -> None:
    env = make_env(config)
    observation = env.reset(start=start, goal=goal)
    rover = env.base_env
    ranges = rover.state.sensed.ranges[0].clamp(max=config.lidar.max_range).numpy()
    x, y, yaw = start[0].tolist()
    angles = rover.scanner.angles.numpy() + yaw
    origin = np.array([x + MOUNT * np.cos(yaw), y + MOUNT * np.sin(yaw)])
    ends = origin + ranges[:, None] * np.stack((np.cos(angles), np.sin(angles)), -1)
    draw_map(axes, get_world("maze"), ((-4.5, 4.5), (-4.5, 4.5)))
    for end in ends:
        axes.plot(*zip(origin, end, strict=True), color="tab:orange", linewidth=0.6, alpha=0.7, zorder=4)
    axes.scatter(*ends.T, s=6, color="tab:red", zorder=5)
    # The segments begin straight ahead and follow counter-clockwise.
    readings = observation["lidar"][0].numpy()
    edges = yaw + np.linspace(0, 2 * np.pi, len(readings) + 1)
    for reading, low, high in zip(readings, edges, edges[1:], strict=False):
        arc = np.linspace(low, high, 8)
        inner = origin[:, None] + reading * np.stack((np.cos(arc), np.sin(arc)))
        axes.plot(*inner, color="tab:blue", linewidth=2, zorder=6)
    env.close()


start, goal = torch.tensor([[0.5, -1.0, 0.6]]), torch.tensor([[3.0, 3.0]])
figure, axes = plt.subplots(figsize=(6.5, 6.5), layout="constrained")
draw_scan(axes, EnvConfig(world="maze", num_envs=1, seed=0))
axes.set_title("red: 128 beams; blue: the 32 readings of the observation")
plt.show()

# %%
# Other lidars
# ------------
# ``LidarConfig`` sets beams, readings and range. ``Randomization`` adds noise and missing beams.

figure, panels = plt.subplots(1, 3, figsize=(13, 4.6), layout="constrained")
variants = {
    "32 beams, 16 readings": EnvConfig(lidar=LidarConfig(points=16, beams=32)),
    "range of 2 m": EnvConfig(lidar=LidarConfig(max_range=2.0)),
    "noise of 5 cm, 10 % dropout": EnvConfig(randomization=Randomization(range_noise=0.05, dropout=0.1)),
}
for axes, (title, variant) in zip(panels, variants.items(), strict=True):
    draw_scan(
        axes, EnvConfig(world="maze", num_envs=1, seed=0, lidar=variant.lidar, randomization=variant.randomization)
    )
    axes.set(title=title, xlabel="", ylabel="")
plt.show()
