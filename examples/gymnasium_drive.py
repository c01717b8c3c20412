"""A hand-written controller in the Gymnasium environment, for one rover and for a batch of sixteen.

    python examples/gymnasium_drive.py

The controller turns the rover toward its goal and steers away from obstacles ahead. The first part prints the distance
and direction of the goal every two seconds, and the result of the episode. The second part counts the goals that the
sixteen rovers reach. The controller fails where a wall stands between the rover and its goal; driving around walls
takes a trained policy.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import tyro

import rover_rl  # noqa: F401, registers the environment with Gymnasium


def compute_action(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Forward speed (m/s) and heading offset (rad) of one rover or of a batch: ``[..., 2]``.

    ``target`` holds the distance and relative angle of the goal. ``lidar`` readings are ordered counterclockwise from
    straight ahead: the first ones are ahead to the left, the last ones ahead to the right.
    """
    angle = observation["target"][..., 1]
    left, right = observation["lidar"][..., :4].min(-1), observation["lidar"][..., -4:].min(-1)
    ahead = np.minimum(left, right)
    heading = np.where(ahead > 0.8, 2 * angle, np.where(left > right, 1.5, -1.5))
    speed = np.clip(np.cos(heading), 0.0, 1.0) * np.clip(ahead, 0.2, 1.0)
    return np.stack((speed, np.clip(heading, -np.pi, np.pi)), -1)


def run_single(world: str, steps: int) -> None:
    """Drives one rover to one goal and prints its progress."""
    env = gymnasium.make("rover_rl/Rover-v0", world_n=world, end_on_goal=True, time_limit="truncated", length=steps)
    observation, info = env.reset(seed=1)
    total, ended = 0.0, False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(compute_action(observation))
        total += reward
        ended = terminated or truncated
        if info["steps"] % 40 == 0:
            distance, angle = observation["target"]
            print(f"{info['steps'] / 20:5.1f} s: the goal is {distance:5.2f} m away, {np.degrees(angle):+4.0f} degrees")
    result = "goal reached" if info["goal_reached"] else "no goal reached"
    print(f"{result} after {info['steps'] / 20:.1f} s, with a return of {total:.1f}")
    env.close()


def run_batch(world: str, steps: int, rovers: int = 16) -> None:
    """Drives a batch of rovers and prints the number of goals. A rover that reaches its goal gets a new one."""
    envs = gymnasium.make_vec(
        "rover_rl/Rover-v0", num_envs=rovers, vectorization_mode="vector_entry_point", world_n=world
    )
    observations, _ = envs.reset(seed=0)
    goals = jams = 0
    for _ in range(steps):
        observations, _, _, _, infos = envs.step(compute_action(observations))
        goals += np.sum(infos.get("goal_reached", 0))
        jams += np.sum(infos.get("jammed", 0))
    print(f"{rovers} rovers reached {goals} goals in {steps / 20:.0f} s and jammed at obstacles {jams} times")
    envs.close()


def main(world: str = "inspect", steps: int = 1000) -> None:
    """Drives with a hand-written controller.

    Args:
        world: name of the world.
        steps: maximum number of steps of 0.05 s.
    """
    run_single(world, steps)
    run_batch(world, steps)


if __name__ == "__main__":
    tyro.cli(main)
