"""
Your own reward
===============

A reward is a list of components. This script adds one, drives a pretrained policy on the moon, and plots what each
component pays along the way.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import torch
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl import RewardComponent, contract_reward, make_env
from rover_rl.algos.pretrained import load_pretrained

# %%
# A component
# -----------
# ``value`` returns one number for each rover, ``[N, 1]``, from the events of the step and the observation.


class TiltPenalty(RewardComponent):
    """Penalty proportional to pitch and roll."""

    name = "tilt"

    def value(self, outcome: TensorDictBase, observation: TensorDictBase) -> Tensor:
        return -0.1 * observation["imu"][:, :2].abs().sum(-1, keepdim=True)


env = make_env(world_n="moon", num_envs=8, seed=3, reward=[*contract_reward(), TiltPenalty()])

# %%
# A drive
# -------
# The components are in the rollout, beside their sum.

STEPS = 240  # of 0.05 s
policy = load_pretrained("moon-ppo").make_actor()
with torch.no_grad():
    rollout = env.rollout(STEPS, policy, break_when_any_done=False)
components = rollout["next", "reward_components"]
print(list(components.keys()))
torch.testing.assert_close(sum(components.values()), rollout["next", "reward"])
env.close()

# %%
# Over time
# ---------
# The dense components of the rover with the most goals. At a goal it gets 100, and the dense components pause.

reached = rollout["next", "outcome", "goal_reached"].squeeze(-1)
row = int(reached.sum(-1).argmax())
seconds = torch.arange(1, rollout.shape[1] + 1) * env.base_env.control_dt
figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
for name in ("progress", "velocity", "turn", "tilt", "collision"):
    axes.plot(seconds, components[name][row], label=name)
for second in seconds[reached[row]]:
    axes.axvline(second, color="gold", linewidth=2, zorder=0)
axes.plot([], [], color="gold", linewidth=2, label="goal reached")
axes.set(xlabel="time (s)", ylabel="reward of a step")
axes.legend(ncols=3)
axes.grid(alpha=0.3)
plt.show()

# %%
# In sum
# ------
# Means per rover over the drive: what a component weighs beside the others.

totals = {name: value.sum(1).mean().item() for name, value in components.items()}
figure, axes = plt.subplots(figsize=(8, 3.2), layout="constrained")
colors = ["tab:red" if total < 0 else "tab:green" for total in totals.values()]
bars = axes.barh(list(totals), list(totals.values()), color=colors)
axes.bar_label(bars, fmt="%.1f", padding=3)
axes.set(xlabel="reward per rover", xscale="symlog", xlim=(-60, 1000))
axes.invert_yaxis()
plt.show()
