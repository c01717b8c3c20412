"""
Fine-tuning
===========

A policy that was trained on the moon meets the maze for the first time, and trains there for half a minute. It drives
from the same starts before and after. Half a minute shows how it is done; a gain that exceeds the noise of 32 episodes
takes minutes.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import mkdtemp

import matplotlib.pyplot as plt

from rover_rl.algos.evaluation.episodes import choose_episodes
from rover_rl.algos.evaluation.evaluate import environment_for, evaluate
from rover_rl.algos.evaluation.plots import draw_paths
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.algos.train import train
from rover_rl.algos.train.fine_tuning import fine_tuning_config

# %%
# Before
# ------
# The stored episodes of the maze, each from a start to a goal.

EPISODES = 32
SECONDS = 60.0
episodes = choose_episodes("maze", EPISODES)


def success(policy, name):
    env = replace(environment_for(policy, None), backend="warp")
    evaluation = evaluate(policy, episodes, name=name, env=env, seconds=SECONDS)
    print(f"{name}: {int(evaluation.reached.sum())} of {EPISODES} goals")
    return evaluation


before = success(load_pretrained("moon-ppo").make_actor(), "moon-ppo")

# %%
# Training
# --------
# ``rover-rl train --from pretrained:moon-ppo --world maze`` does the same for two minutes. Weights, networks and
# settings come from the policy. The critic is new, and learns alone at first.

STEPS = 100_000
config = fine_tuning_config(
    "pretrained:moon-ppo", world="maze", total_steps=STEPS, backend="warp", seed=0, runs=mkdtemp(), name="maze"
)
summary = train(config)

# %%
# After
# -----

after = success(Checkpoint.load(Path(summary.folder)).make_actor(), "fine-tuned")

# %%
# The paths of both, from the same starts.

draw_paths([before, after], Path(summary.folder) / "paths.png")
plt.figure(figsize=(10, 5), layout="constrained")
plt.imshow(plt.imread(Path(summary.folder) / "paths.png"))
plt.axis("off")
plt.show()
