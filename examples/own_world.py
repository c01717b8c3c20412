"""
Your own world
==============

A world is a grid of heights with convex obstacles on it. This one has a valley, a ring of posts and a gate. The script
draws its map, places a rover in it, and shows what its lidar and a camera see.
"""

from __future__ import annotations

import math

import matplotlib.pyplot as plt
import numpy as np
import torch

from rover_rl import Terrain, World, box, cylinder, make_env
from rover_rl.robots import get_robot
from rover_rl.sims.free_space.draw import draw_world

# %%
# Ground and obstacles
# --------------------
# Heights are in meters, here on a grid of 0.25 m. The grid is centered at 0, 0.

CELL, CELLS = 0.25, 65
x, y = np.meshgrid(*(CELL * (np.arange(CELLS) - CELLS // 2),) * 2)
valley = 0.8 * np.tanh((y / 3) ** 2)
bumps = 0.08 * np.sin(1.7 * x) * np.cos(2.3 * y)
terrain = Terrain(valley + bumps, cell=CELL)


def height(x: float, y: float) -> float:
    return terrain.height_at(torch.tensor([x, y])).item()


posts = []
for turn in np.arange(7) * 2 * math.pi / 7:
    px, py = 4 * math.cos(turn), 4 * math.sin(turn)
    posts.append(cylinder((px, py, height(px, py) + 0.4), radius=0.3, height=1.6))
gate = [box((0, side, height(0, side) + 0.4), size=(0.4, 1.2, 1.6)) for side in (-1.4, 1.4)]
world = World("valley", terrain, [*posts, *gate])

# %%
# The map
# -------
# Green is where the rover can drive: clear of obstacles, not too steep, and connected. Starts and goals are drawn
# there.

figure, axes = plt.subplots(figsize=(7, 7), layout="constrained")
draw_world(world, get_robot("rover_zero"), ax=axes)
plt.show()

# %%
# A rover in it
# -------------
# ``reset`` takes a start pose (x, y, yaw) and a goal. The lidar has 128 beams. ``env.base_env`` is the ``RoverEnv``
# under the reward.

env = make_env(world_n=world, num_envs=1, seed=0)
env.reset(start=torch.tensor([[-3.0, 0.0, 0.0]]), goal=torch.tensor([[3.0, 0.0]]))
rover = env.base_env
ranges = rover.scan[0].numpy()
angles = rover.scanner.angles.numpy()
seen = np.isfinite(ranges)
print(f"{int(seen.sum())} of {len(ranges)} beams hit something, the nearest after {ranges.min():.2f} m")

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained", width_ratios=(1, 1.25))
left.remove()
left = figure.add_subplot(1, 2, 1, projection="polar", theta_offset=math.pi / 2)
left.vlines(angles[seen], 0, ranges[seen], color="tab:orange", alpha=0.4, linewidth=1)
left.scatter(angles[seen], ranges[seen], s=10, color="tab:red")
left.set_title("lidar scan (m), straight ahead is up")
right.imshow(rover.render(view="chase", width=640, height=480).numpy())
right.set_axis_off()
right.set_title("camera behind the rover")
plt.show()

# %%
# In training
# -----------
# ``make_env(world_n=world, num_envs=64)`` trains in it. On the command line, a function that returns it has a name:
# ``rover-rl train --world my_package:valley``.

rollout = env.rollout(20)
print("reward of 20 random steps:", round(rollout["next", "reward"].sum().item(), 3))
env.close()
