"""
A controller in Gymnasium
=========================

A hand-written controller drives one rover, and then a batch of sixteen, through Gymnasium's interface. It turns the
rover toward its goal and steers away from obstacles ahead. It fails where a wall stands between the rover and its goal:
driving around walls takes a trained policy.
"""

from __future__ import annotations

import gymnasium
import matplotlib.pyplot as plt
import numpy as np

import rover_rl  # noqa: F401, registers the environment with Gymnasium
from rover_rl.worlds import get_world
from rover_rl.worlds.draw import draw_map

STEPS = 200  # of 0.05 s

# %%
# The controller
# --------------
# ``target`` holds the distance and the relative angle of the goal. ``lidar`` readings are ordered counterclockwise from
# straight ahead: the first ones are ahead to the left, the last ones ahead to the right. An action is a forward speed
# (m/s) and a heading offset (rad). The same function serves one rover and a batch: ``[..., 2]``.


def compute_action(observation: dict[str, np.ndarray]) -> np.ndarray:
    angle = observation["target"][..., 1]
    left, right = observation["lidar"][..., :4].min(-1), observation["lidar"][..., -4:].min(-1)
    ahead = np.minimum(left, right)
    heading = np.where(ahead > 0.8, 2 * angle, np.where(left > right, 1.5, -1.5))
    speed = np.clip(np.cos(heading), 0.0, 1.0) * np.clip(ahead, 0.2, 1.0)
    return np.stack((speed, np.clip(heading, -np.pi, np.pi)), -1)


# %%
# One rover
# ---------
# ``end_on_goal`` ends the episode at the first goal. By default, a new goal follows.

env = gymnasium.make("rover_rl/Rover-v0", world_n="inspect", end_on_goal=True, time_limit="truncated", length=STEPS)
observation, info = env.reset(seed=1)
total, ended = 0.0, False
path = [observation["pose"][:2]]
while not ended:
    observation, reward, terminated, truncated, info = env.step(compute_action(observation))
    total += reward
    ended = terminated or truncated
    path.append(observation["pose"][:2])
    if info["steps"] % 40 == 0:
        distance, angle = observation["target"]
        print(f"{info['steps'] / 20:5.1f} s: the goal is {distance:5.2f} m away, {np.degrees(angle):+4.0f} degrees")
result = "goal reached" if info["goal_reached"] else "no goal reached"
print(f"{result} after {info['steps'] / 20:.1f} s, with a return of {total:.1f}")
env.close()

# %%
# The path on the map of the world:

world = get_world("inspect")
figure, axes = plt.subplots(figsize=(6, 5), layout="constrained")
elevation = draw_map(axes, world, ((-28, -18), (-28, -18)))
figure.colorbar(elevation, ax=axes, label="elevation (m)")
axes.plot(*np.transpose(path), color="tab:blue", linewidth=2, zorder=4)
axes.plot(*path[0], "o", color="white", markeredgecolor="black", label="start", zorder=5)
axes.plot(*path[-1], "*", color="gold", markeredgecolor="black", markersize=14, label="end", zorder=5)
axes.legend()
plt.show()

# %%
# Sixteen rovers
# --------------
# The batch is one vector environment. A rover that reaches its goal gets a new one.

ROVERS = 16
envs = gymnasium.make_vec(
    "rover_rl/Rover-v0", num_envs=ROVERS, vectorization_mode="vector_entry_point", world_n="inspect"
)
observations, _ = envs.reset(seed=0)
goals = jams = 0
for _ in range(STEPS):
    observations, _, _, _, infos = envs.step(compute_action(observations))
    goals += np.sum(infos.get("goal_reached", 0))
    jams += np.sum(infos.get("jammed", 0))
print(f"{ROVERS} rovers reached {goals} goals in {STEPS / 20:.0f} s and jammed at obstacles {jams} times")
envs.close()
