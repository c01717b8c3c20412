"""``ForesightPolicy``: planner that knows where all movers will be, as an upper bound of what a policy can do.

It plans in the true world with a :class:`~rover_rl.algos.policy.space_time.SpaceTimePlanner`: a plan every second, and
ten decisions a second.

Example:
    >>> from rover_rl.algos.policy.runner import PolicyRunner
    >>> env = RoverEnv(world_n="plaza", num_envs=2, backend="warp", seed=0)
    >>> runner = PolicyRunner(ForesightPolicy(), env=env)
    >>> runner(env.reset()).shape
    torch.Size([2, 2])
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from rover_rl.algos.policy.space_time import Plans, SpaceTimePlanner, fixed_struct, moving_struct, window
from rover_rl.envs.config import EnvConfig, RobotLike
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.specs import action_bounds
from rover_rl.envs.transforms.path_reward import CAUTION, world_of
from rover_rl.robots import get_robot
from rover_rl.robots.slip import estimated_yaw_gain
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.free_space.paths import PathDistances
from rover_rl.sims.movers import MoverField
from rover_rl.worlds import World
from rover_rl.worlds.clearance import clearance_on_grid
from rover_rl.worlds.movers.shapes import KINDS
from rover_rl.worlds.world import Worlds

REPLAN = 20  # number of steps from one plan to the next
DECIDE = 2  # number of steps from one decision to the next
SPACING = 0.1  # spacing of the distances to what does not move, m
MOST = 1024  # largest number of these distances along a side
LIMIT = 1.0  # largest of these distances, m
NEAR = 1.5  # distance to the goal below which the way to it is straight, m
NO_PATH = 20.0  # cost of places from which no path leads to the goal, s
_AWAY = 1e6  # coordinate of movers that do not exist, m


class _Memory(NamedTuple):
    """Plans of all rows, the step of each plan (-1: none), and the actions."""

    plans: Plans
    step: Tensor
    action: Tensor


class _Place(NamedTuple):
    """Where a policy drives. A tuple, so that the environment, a module, does not become a part of the policy."""

    env: RoverEnv
    planner: SpaceTimePlanner
    paths: PathDistances
    fixed: FixedDistances


class ForesightPolicy(TensorDictModuleBase):
    """Planner that knows the world and where all movers will be: see the module ``foresight``.

    Movers that react, or move at random, are taken to keep their velocity. A
    :class:`~rover_rl.algos.policy.runner.PolicyRunner` with an environment tells it the worlds and the movers.

    Args:
        robot: name of a robot, or a robot, whose footprint and limits are used.
        yaw_gain: yaw rate of the body relative to that of the wheel odometry; ``None``: an estimate from the drive.

    Attributes:
        made_for: environment that the policy drives in, with ``robot``.

    Raises:
        ValueError: for an unknown robot.
    """

    def __init__(self, robot: RobotLike = "rover_zero", yaw_gain: float | None = None) -> None:
        super().__init__()
        self._robot = get_robot(robot)
        self._gain = estimated_yaw_gain(self._robot) if yaw_gain is None else yaw_gain
        self.made_for = EnvConfig(robot=robot)
        self.in_keys, self.out_keys = ["velocities", "outcome"], ["action"]
        self._place: _Place | None = None

    def __getstate__(self) -> dict[str, Any]:
        # For another process, which has its own environment.
        return {**self.__dict__, "_place": None, "_memory": None}

    def enter(self, env: RoverEnv) -> None:
        """Prepares for the worlds, the movers and the robot of an environment."""
        rows, device = env.num_envs, env.placement.bounds.device
        speed = min(self._robot.drive.max_speed, action_bounds(env.config.bounded_action).high[0])
        self._place = _Place(
            env,
            SpaceTimePlanner(self._robot, self._gain, speed, env.task.success_distance),
            PathDistances(env.pool, self._robot, device, CAUTION),
            FixedDistances(env.pool, device),
        )
        step = torch.full((rows,), -1, dtype=torch.int64, device=device)
        self._memory = _Memory(Plans.empty(rows, device), step, torch.zeros(rows, 2, device=device))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets ``action [N, 2]``. Raises ``RuntimeError`` before :meth:`enter`."""
        if self._place is None:
            raise RuntimeError("foresight knows no environment: drive it with PolicyRunner(policy, env=env)")
        env = self._place.env
        # A runner adds copies of the last row to few rows.
        rows = tensordict[: env.num_envs]
        steps, goal, memory = rows["outcome", "steps"][:, 0], env.goal, self._memory
        age = steps - memory.step
        changed = (age < 0) | (memory.step < 0) | (goal != memory.plans.goal).any(-1)
        due = changed | (steps % DECIDE == 0)
        world = world_of(rows)[:, 0]
        self._plan(changed | (due & (age >= REPLAN)), steps, goal, world)
        self._decide(due, steps, world, rows["velocities"])
        action = self._memory.action
        extra = action.new_zeros(len(tensordict) - len(rows), 2)
        return tensordict.set("action", torch.cat((action, extra)))

    def _plan(self, rows: Tensor, steps: Tensor, goal: Tensor, world: Tensor) -> None:
        """Computes the costs to go of ``rows``, bool ``[N]``."""
        chosen = rows.nonzero().squeeze(-1)
        if not len(chosen):
            return
        (env, planner, paths, fixed), memory = self._entered, self._memory
        origin, offsets = window(env.rover_state.position[:, :2])
        plans = memory.plans._replace(
            origin=torch.where(rows[:, None], origin, memory.plans.origin),
            goal=torch.where(rows[:, None], goal, memory.plans.goal),
        )
        self._memory = memory._replace(plans=plans, step=torch.where(rows, steps, memory.step))
        points = plans.origin[chosen, None] + offsets
        length, is_free = paths.along(paths.fields(world[chosen], goal[chosen]), points)
        straight = (points - goal[chosen, None]).norm(dim=-1)
        length = torch.where(straight < NEAR, straight, length) / planner.speed
        plans.costs[chosen, -1] = torch.where(is_free, length, straight / planner.speed + NO_PATH)
        planner.plan(plans, chosen, fixed.struct(world), moving_at(env.movers, planner.plan_instants))

    def _decide(self, rows: Tensor, steps: Tensor, world: Tensor, velocities: Tensor) -> None:
        """Decides on the actions of ``rows``, bool ``[N]``."""
        chosen = rows.nonzero().squeeze(-1)
        if not len(chosen):
            return
        (env, planner, _, fixed), memory = self._entered, self._memory
        rover = env.rover_state
        place = torch.cat((rover.position[:, :2], quaternion_to_euler(rover.orientation)[:, 2:]), -1)
        since = ((steps - memory.step) * env.control_dt).float()
        moving = moving_at(env.movers, planner.drive_instants)
        action = planner.decide(memory.plans, chosen, since, place, velocities, fixed.struct(world), moving)
        self._memory = memory._replace(action=torch.where(rows[:, None], action.to(memory.action), memory.action))

    @property
    def _entered(self) -> _Place:
        assert self._place is not None
        return self._place


class FixedDistances:
    """Distances to what does not move, in the worlds of an environment.

    Args:
        worlds: worlds, by index.
        device: device of the distances.
    """

    def __init__(self, worlds: Worlds, device: torch.device) -> None:
        self._worlds, self._device, self._slots = worlds, device, dict[int, int]()
        self._grids: list[tuple[Tensor, Tensor]] = []

    def struct(self, world: Tensor) -> Any:
        """Returns the distances around rows in worlds ``[N]``, as the kernels read them."""
        if missing := [index for index in world.unique().tolist() if index not in self._slots]:
            for index in missing:
                self._slots[index] = len(self._grids)
                self._grids.append(_clearance(self._worlds[index]))
            clearance, frames = zip(*self._grids, strict=True)
            self._clearance = pad_sequence(list(clearance), batch_first=True).to(self._device)
            self._frames = torch.stack(frames).to(self._device)
        slots = torch.tensor([self._slots[index] for index in world.tolist()], device=world.device)
        return fixed_struct(slots, self._frames, self._clearance)


@lru_cache(maxsize=256)
def _clearance(world: World) -> tuple[Tensor, Tensor]:
    """Returns distances ``[points]`` on a grid over the terrain, and the grid."""
    (left, right), (bottom, top) = world.terrain.extent
    spacing = max(SPACING, max(right - left, top - bottom) / MOST)
    xs, ys = np.arange(left, right + spacing, spacing), np.arange(bottom, top + spacing, spacing)
    distances = clearance_on_grid(world, xs, ys, LIMIT)
    return distances.float().flatten(), torch.tensor([left, bottom, spacing, len(ys), len(xs)])


def moving_at(movers: MoverField, seconds: list[float]) -> Any:
    """Returns where movers will be, as the kernels read it."""
    later = [movers.ahead(each) for each in seconds]
    places = [course.position.masked_fill(~movers.present[..., None], _AWAY) for course in later]
    return moving_struct(places, [course.yaw for course in later], _forms(movers))


def _forms(movers: MoverField) -> Tensor:
    """Returns half the length and width of boxes, and the radius of other movers, ``[N, M, 3]``, m."""
    parts = movers.parts
    if parts is None:
        return torch.zeros(*movers.radius.shape, 3, device=movers.radius.device)
    exists = (parts.kind >= 0).float()
    count = torch.zeros_like(movers.radius).scatter_add(1, parts.mover, exists)
    is_box = (parts.kind == KINDS.index("box")) & (count.gather(1, parts.mover) == 1)
    half = torch.zeros(*movers.radius.shape, 2, device=exists.device)
    half = half.scatter_add(
        1, parts.mover[..., None].expand(*parts.mover.shape, 2), parts.half[..., :2] * is_box[..., None]
    )
    return torch.cat((half, torch.where(half.sum(-1) > 0, 0.0, movers.radius)[..., None]), -1).contiguous()
