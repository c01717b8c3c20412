"""
A map of ROS
============

A map that ``map_server`` saves, a picture of gray values and a YAML file beside it, becomes a world. This script
writes a small one, imports it, and lets a pretrained policy drive in it, which has never seen it, beside the planner
that the policy adds to. Meshes, elevation models and worlds of Gazebo are imported in the same way.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from rover_rl import World
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import environment_for, evaluate
from rover_rl.algos.policy.names import make_baseline
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.robots import get_robot
from rover_rl.sims.free_space.draw import draw_world
from rover_rl.worlds.draw import draw_map

# %%
# The files
# ---------
# Four rooms and a corridor. A pixel is 0.1 m wide, 254 is free, and 0 a wall. The first row is in the north.

free = np.zeros((90, 140), dtype=bool)
free[2:37, 2:68] = free[2:37, 70:138] = True  # two rooms in the north
free[39:54, 2:138] = True  # a corridor
free[56:88, 2:90] = free[56:88, 92:138] = True  # two rooms in the south
free[37:39, 30:42] = free[37:39, 100:112] = free[54:56, 12:24] = free[54:56, 110:122] = True  # doors
free[12:24, 16:28] = free[66:76, 40:60] = False  # furniture

folder = Path(tempfile.mkdtemp())
pixels = np.where(free, 254, 0).astype(np.uint8)
(folder / "office.pgm").write_bytes(b"P5 %d %d 255\n" % pixels.shape[::-1] + pixels.tobytes())
(folder / "office.yaml").write_text(
    "image: office.pgm\nresolution: 0.1\norigin: [-7.0, -4.5, 0.0]\n"
    "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
)

# %%
# The world
# ---------
# The notes tell what was understood. On the command line: ``rover-rl worlds import office.yaml``, then
# ``rover-rl worlds show office.world.npz``. Green is where starts and goals are drawn.

world = World.from_file(folder / "office.yaml")
print(*world.notes, sep="\n")
figure, axes = plt.subplots(figsize=(9, 6), layout="constrained")
draw_world(world, get_robot("rover_zero"), ax=axes)
plt.show()

# %%
# A drive
# -------
# Both policies get the same starts and goals, in the simulator Warp.

EPISODES = 6
episodes = draw_episodes(world, EPISODES, min_path=4.0)
results = []
policies = {"anywhere": load_pretrained("anywhere").make_actor(), "gridplanner": make_baseline("gridplanner")}
for name, policy in policies.items():
    env = replace(environment_for(policy, None), backend="warp")
    results.append(evaluate(policy, episodes, name=name, env=env))

figure, panels = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained", sharey=True)
for axes, result in zip(panels, results, strict=True):
    draw_map(axes, world, ((-7.2, 7.2), (-4.7, 4.7)))
    for number, path in enumerate(result.paths):
        color = plt.get_cmap("tab10")(number)
        axes.plot(*path.T, color=color, linewidth=2, zorder=4)
        axes.plot(*episodes.goal[number], "*", color=color, markeredgecolor="black", markersize=12, zorder=6)
    seconds = result.metrics["mean_time_to_traverse"].value
    axes.set_title(f"{result.name}: {result.reached.sum()} of {EPISODES} goals, {seconds:.1f} s each")
    print(f"{result.name}: {result.reached.sum()} of {EPISODES} goals")
plt.show()

# %%
# In training
# -----------
# ``rover-rl train --from pretrained:anywhere --world office.world.npz`` goes on from the pretrained policy in this
# world.
