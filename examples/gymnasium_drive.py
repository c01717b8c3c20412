"""A hand-written driver in the Gymnasium environment: first one rover to its goal, then sixteen at once.

    python examples/gymnasium_drive.py

The rover turns towards its goal and drives, but away from what it sees right in front. The first part prints where the
goal is every two seconds, and in the end how the episode went; the second counts the goals that sixteen rovers reach.
Such a driver gets stuck wherever a wall stands between it and the goal. That is what learning is for.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import tyro

import rover_rl  # noqa: F401, it makes the environment known to Gymnasium


def drive(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Forward speed (m/s) and heading offset (rad) of one rover, or of many: ``[..., 2]``.

    ``target`` is the distance and the relative angle of the goal. The readings of ``lidar`` go counter-clockwise from
    straight ahead, so that the first ones are ahead to the left, and the last ones ahead to the right.
    """
    angle = observation["target"][..., 1]
    left, right = observation["lidar"][..., :4].min(-1), observation["lidar"][..., -4:].min(-1)
    ahead = np.minimum(left, right)
    heading = np.where(ahead > 0.8, 2 * angle, np.where(left > right, 1.5, -1.5))
    speed = np.clip(np.cos(heading), 0.0, 1.0) * np.clip(ahead, 0.2, 1.0)
    return np.stack((speed, np.clip(heading, -np.pi, np.pi)), -1)


def drive_one(world: str, steps: int) -> None:
    """One rover, one goal."""
    env = gymnasium.make("rover_rl/Rover-v0", world_n=world, end_on_goal=True, time_limit="truncated", length=steps)
    observation, info = env.reset(seed=1)
    total, ended = 0.0, False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(drive(observation))
        total += reward
        ended = terminated or truncated
        if info["steps"] % 40 == 0:
            distance, angle = observation["target"]
            print(f"{info['steps'] / 20:5.1f} s: the goal is {distance:5.2f} m away, {np.degrees(angle):+4.0f} degrees")
    result = "goal reached" if info["goal_reached"] else "no goal reached"
    print(f"{result} after {info['steps'] / 20:.1f} s, with a return of {total:.1f}")
    env.close()


def drive_many(world: str, steps: int, rovers: int = 16) -> None:
    """A batch of rovers, stepped as one; each gets a new goal when it has reached one."""
    envs = gymnasium.make_vec(
        "rover_rl/Rover-v0", num_envs=rovers, vectorization_mode="vector_entry_point", world_n=world
    )
    observations, _ = envs.reset(seed=0)
    goals = jams = 0
    for _ in range(steps):
        observations, _, _, _, infos = envs.step(drive(observations))
        goals += np.sum(infos.get("goal_reached", 0))
        jams += np.sum(infos.get("jammed", 0))
    print(f"{rovers} rovers reached {goals} goals in {steps / 20:.0f} s, and {jams} times one ran into something")
    envs.close()


def main(world: str = "inspect", steps: int = 1000) -> None:
    """Drives by hand-written rules.

    Args:
        world: to drive in.
        steps: of 0.05 s, at most.
    """
    drive_one(world, steps)
    drive_many(world, steps)


if __name__ == "__main__":
    tyro.cli(main)
