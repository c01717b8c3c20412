"""Interactive session: an environment, the policy that drives in it, and what happens inside.

A person may change the policy, the world and the goals between two steps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl.algos.driving import Drive
from rover_rl.algos.evaluation.evaluate import MADE_FOR
from rover_rl.algos.policy.baselines import RandomPolicy
from rover_rl.algos.policy.runner import Policy, PolicyRunner, sensors_for
from rover_rl.algos.video.recording import Episode, Moment, Tally
from rover_rl.envs.actions import action_bounds
from rover_rl.envs.config import EnvConfig, require_match
from rover_rl.envs.make import RewardedEnv, make_env
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.movers import movers_in_world
from rover_rl.envs.sensors.route import map_of
from rover_rl.envs.sensors.suite import MOVERS
from rover_rl.envs.task import StepEvent
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.free_space.paths import PathGrid
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds import World

KEPT = 600  # number of steps that are kept
VALUE = "value"  # name of the record of the estimated value
KEPT_EPISODES = 12  # number of rows of the table of episodes
FREE = 3  # level of the cells of a map from which on they are free
Critic: TypeAlias = Callable[[TensorDictBase], float]  # estimates the value of an observation ``[1]``


@dataclass(frozen=True)
class Pose:
    """Positions ``[N, 3]`` (m) and orientations ``[N, 4]`` (x, y, z, w) of rovers, on the CPU."""

    position: Tensor
    orientation: Tensor

    @classmethod
    def of(cls, rover: RoverState) -> Pose:
        return cls(rover.position.cpu(), rover.orientation.cpu())

    def toward(self, other: Pose, share: float) -> Pose:
        """Poses between these and others. A rover that has been put elsewhere is there at once."""
        near = (self.position - other.position).norm(dim=-1, keepdim=True) < 1.0
        share_of = torch.where(near, share, 1.0)
        sign = torch.where((self.orientation * other.orientation).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        turned = torch.lerp(self.orientation * sign, other.orientation, share_of)
        return Pose(torch.lerp(self.position, other.position, share_of), turned / turned.norm(dim=-1, keepdim=True))


class Session:
    """Environment, policy (``None`` acts at random) and the records of their steps. One thread uses it.

    Attributes:
        row: rover that is followed.
        exploring: whether the policy draws its actions, as in training, rather than takes the best ones.
        config: description of the environment, without the sensors that only the policy needs.
    """

    def __init__(self, env: EnvBase, policy: Policy | None) -> None:
        self.row, self.exploring = 0, False
        self._critic: Critic | None = None
        self._set_env(env)
        self.config: EnvConfig = getattr(env, "config", self.rovers.config)
        self.set_policy(policy)
        self.reset()

    def _set_env(self, env: EnvBase) -> None:
        self.env, self._drive = env, Drive(env, None)
        self.rovers = self._drive.rovers
        self._grid: tuple[World, PathGrid] | None = None

    @property
    def observation(self) -> TensorDictBase:
        return self._drive.observation

    @property
    def can_change(self) -> bool:
        return isinstance(self.env, (RoverEnv, RewardedEnv))

    def change(self, **changes: Any) -> None:
        """Makes the environment anew with other settings, such as ``world`` and ``backend``."""
        self._make(replace(self.config, **changes), self._policy)
        self.set_policy(self._policy, self._critic)
        self.reset()

    def _make(self, config: EnvConfig, policy: Policy | None) -> None:
        new = make_env(sensors_for(policy, config))
        self.env.close()
        self._set_env(new)
        self.config = config

    def set_robot(self, robot: str, policy: Policy | None) -> None:
        """Lets another robot drive, with a policy for it. Raises ``ValueError`` if the policy is for another robot."""
        if made_for := getattr(policy, "made_for", None):
            require_match(made_for, replace(made_for, robot=robot))
        self._policy, self._critic = policy, None
        self.change(robot=robot)

    def set_policy(self, policy: Policy | None, critic: Critic | None = None) -> None:
        """Lets another policy drive. If it needs another environment, makes it anew.

        ``critic`` estimates values from observations. Raises ``ValueError`` if the environment cannot be made anew.
        """
        config = self.config
        if made_for := getattr(policy, "made_for", None):
            try:
                require_match(made_for, config)
            except ValueError:
                if not self.can_change:
                    raise
                config = replace(config, **{name: getattr(made_for, name) for name in MADE_FOR})
        reads_more = not {*sensors_for(policy, config).sensors} <= {*self.rovers.config.sensors}
        anew = config is not self.config or (reads_more and self.can_change)
        if anew:
            self._make(config, policy)
        self._policy, self._critic = policy, critic
        self._drive.runner = PolicyRunner(policy or RandomPolicy(), env=self.rovers)
        if anew:
            self.reset()

    def reset(self) -> None:
        self._drive.begin()
        self._tally, self.seconds = Tally(self.rovers.num_envs), 0.0
        self.history: dict[str, deque[float]] = {}

    @property
    def episodes(self) -> list[Episode]:
        """Episodes that have ended, the last one first."""
        return self._tally.ended[: -KEPT_EPISODES - 1 : -1]

    def put(self, row: int, xy: tuple[float, float]) -> None:
        rovers = self.rovers
        yaw = quaternion_to_euler(rovers.rover_state.orientation)[:, 2:]
        start, goal = torch.cat((rovers.rover_state.position[:, :2], yaw), -1), rovers.goal
        start[row, :2] = torch.tensor(xy)
        self._drive.begin(torch.arange(rovers.num_envs) == row, start=start, goal=goal)

    def set_goal(self, row: int, xy: tuple[float, float]) -> None:
        goal = self.rovers.goal
        goal[row] = torch.tensor(xy)
        self.rovers.set_goal(goal)

    def decide(self) -> Tensor:
        return self._drive.decide(exploring=self.exploring)

    def advance(self, action: Tensor, by_hand: int | None = None) -> None:
        """Takes a step. The episode of the rover that is driven ``by_hand`` goes on when it stands for long."""
        before, step = self.observation, self._drive.step(action)
        self.seconds += self.rovers.control_dt
        self._record(before, step.observation, action)
        if by_hand is not None and step.observation["outcome", "phase"][by_hand] in (StepEvent.STUCK, StepEvent.NONE):
            step = step._replace(ended=step.ended & (torch.arange(len(step.ended)) != by_hand))
        self._tally.add(step, self.seconds, self.rovers.control_dt, self.row)
        if step.ended.any():
            self._drive.begin(step.ended)

    def _record(self, before: TensorDictBase, after: TensorDictBase, action: Tensor) -> None:
        row, speed = self.row, self.rovers.rover_state.linear_velocity[self.row].item()
        values = {"distance": after["target"][row, 0].item(), "speed": speed}
        values |= zip(("speed command", "turn command"), action[row].tolist(), strict=False)
        if self._critic is not None:
            values[VALUE] = self._critic(before[row : row + 1])
        if (components := after.get("reward_components", None)) is not None:
            values |= {f"reward {name}": components[name][row].item() for name in sorted(components.keys())}
        for name, value in values.items():
            self.history.setdefault(name, deque(maxlen=KEPT)).append(value)

    def moment(self) -> Moment:
        return self._tally.moment(self.seconds, self.rovers, self.row)

    def neighbors(self) -> Tensor:
        """Rovers in the world of the followed one, int64."""
        worlds = self.rovers.worlds
        return torch.tensor([row for row, world in enumerate(worlds) if world is worlds[self.row]])

    def route(self) -> Tensor:
        row, world = self.row, self.rovers.worlds[self.row]
        if self._grid is None or self._grid[0] is not world:
            self._grid = world, PathGrid(world, self.rovers.robot)
        return self._grid[1].path(self.rovers.rover_state.position[row, :2].cpu(), self.rovers.goal[row].cpu())

    def action_spread(self) -> Tensor | None:
        """Distribution of each part of the followed rover's action, ``[k, 5]``; ``None`` if the policy has none.

        The columns are lower bound, one standard deviation below the center, center, one above it, and upper bound.
        """
        if (distribution := self._drive.runner.distribution) is None:
            return None
        loc, scale = (one[self.row].cpu()[:, None] for one in distribution)
        bounds = action_bounds(self.config.bounded_action)
        low, high = (torch.tensor(one)[:, None] for one in (bounds.low, bounds.high))
        inner = (low + high) / 2 + (high - low) / 2 * (loc + scale * torch.tensor((-1.0, 0.0, 1.0))).tanh()
        return torch.cat((low, inner, high), -1)

    def seen_map(self) -> tuple[Tensor, Tensor] | None:
        """The map that the policy has of what the followed rover has seen, and its route on it; ``None`` without one.

        The cells that are not free are ``[cells, 3]``: x, y (m) and the level of ``SeenMap.levels``. The points of the
        route begin at the rover, ``[3, 2]``, m.
        """
        if (seen := map_of(self.rovers.observer)) is None:
            return None
        (levels, corner), row, rovers = seen.levels(), self.row, self.rovers
        cell = seen.cell[row].item()
        marked = (levels[row] < FREE).nonzero()
        places = corner[row] + cell * (marked.flip(-1) + 0.5)
        cells = torch.cat((places, levels[row][marked[:, 0], marked[:, 1], None]), -1).cpu()
        return cells, torch.cat((rovers.rover_state.position[row : row + 1, :2], seen.corners()[row])).cpu()

    def tracked(self) -> Tensor:
        """Movers that the policy tracks, ``[movers, 5]``: x, y (m), their velocities (m/s) and radius (m)."""
        if self.observation.get(MOVERS, None) is None:
            return torch.zeros(0, 5)
        row = slice(self.row, self.row + 1)
        (movers,) = movers_in_world(*(self.observation[key][row] for key in (MOVERS, "pose", "imu")))
        return movers[movers[:, -1] > 0].cpu()

    def inside(self) -> dict[str, float]:
        """Numbers on the inside of the policy: norms of the parts of a recurrent state."""
        return {f"norm of {key}": value[self.row].norm().item() for key, value in self._drive.runner.state.items()}

    def close(self) -> None:
        self.env.close()
