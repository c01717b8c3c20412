"""
Policies side by side
=====================

A pretrained policy and the scripted baseline drive the same eight episodes in the simulator Warp. The script prints
their metrics and draws their paths.
"""

from __future__ import annotations

from dataclasses import replace

import matplotlib.pyplot as plt

from rover_rl.algos.evaluation.episodes import stored_episodes
from rover_rl.algos.evaluation.evaluate import environment_for, evaluate
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.worlds.draw import draw_map

# %%
# Evaluation
# ----------
# The package stores 256 starts and goals in each world. ``rover-rl evaluate pretrained:anywhere scripted --world maze``
# drives all of them, in Bullet, and writes tables and figures. Each policy gets the environment that it was made for:
# the pretrained one reads 128 lidar points, and the script 32.

EPISODES = 8
episodes = stored_episodes("maze").first(EPISODES)
policies = {"anywhere": load_pretrained("anywhere").make_actor(), "scripted": ScriptedPolicy()}
results = []
for name, policy in policies.items():
    env = replace(environment_for(policy, None), backend="warp")
    results.append(evaluate(policy, episodes, name=name, env=env))

# %%
# Metrics
# -------
# Each has a 95 % confidence interval, which is wide for eight episodes.

for result in results:
    print(f"{result.name}: {result.reached.sum()} of {EPISODES} goals")
    for name in ("success_rate", "spl", "mean_time_to_traverse", "turns_per_goal"):
        estimate = result.metrics[name]
        print(f"    {name:22} {estimate.value:6.2f}  ({estimate.low:.2f} to {estimate.high:.2f})")

# %%
# Paths
# -----

figure, panels = plt.subplots(1, 2, figsize=(11, 5.4), layout="constrained", sharey=True)
for axes, result in zip(panels, results, strict=True):
    draw_map(axes, episodes.world, ((-5, 5), (-5, 5)))
    for number, (path, reached) in enumerate(zip(result.paths, result.reached, strict=True)):
        color = plt.get_cmap("tab10")(number)
        axes.plot(*path.T, color=color, linewidth=2, linestyle="-" if reached else ":", zorder=4)
        axes.plot(*episodes.start[number, :2], "o", color="white", markeredgecolor=color, zorder=5)
        axes.plot(*episodes.goal[number], "*", color=color, markeredgecolor="black", markersize=14, zorder=6)
    axes.set_title(f"{result.name}: {result.success_rate:.0%} of the goals, dotted: failed")
plt.show()
