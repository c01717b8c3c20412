"""``ForesightPolicy``: planner that knows where all movers will be, as an upper bound of what a policy can do.

Every second it computes, for a point that moves at full speed in any direction, how long it takes to the goal from each
place around the rover at each of 40 instants, when movers are where they will be then: by dynamic programming backward
in time, on a grid of 0.2 m and 0.25 s, or less for a robot that is faster than 1 m/s. What comes later is the shortest
path on the map.

Ten times a second it simulates drives of 2.2 s: a speed and a yaw rate for 0.7 s, and others for 1.5 s, with the
robot's limits of acceleration, and the discs that cover it among the movers. The action is the beginning of the drive
that takes least time, including that of the plan from its end.

Example:
    >>> from rover_rl.algos.policy.runner import PolicyRunner
    >>> env = RoverEnv(world_n="plaza", num_envs=2, backend="warp", seed=0)
    >>> runner = PolicyRunner(ForesightPolicy(), env=env)
    >>> runner(env.reset()).shape
    torch.Size([2, 2])
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from rover_rl.algos.policy.dwa import EXCESS, MAX_YAW_RATE
from rover_rl.envs.config import EnvConfig, HeadingGains, RobotLike
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.specs import action_bounds
from rover_rl.envs.transforms.path_reward import CAUTION, world_of
from rover_rl.sims.free_space.path_distance import PathDistances
from rover_rl.sims.movers import MoverField
from rover_rl.sims.robots import get_robot
from rover_rl.sims.robots.footprint import covering_discs
from rover_rl.sims.robots.slip import estimated_yaw_gain
from rover_rl.sims.rotations import quaternion_to_euler
from rover_rl.sims.worlds import World
from rover_rl.sims.worlds.clearance import clearance_on_grid
from rover_rl.sims.worlds.movers.shapes import KINDS
from rover_rl.sims.worlds.world import Worlds

LAYER_DT = 0.25  # largest time from one instant of a plan to the next, s
LAYER_WAY = 0.25  # largest way from one instant of a plan to the next, m
REPLAN = 20  # number of steps from one plan to the next
DECIDE = 2  # number of steps from one decision to the next
SPACING = 0.1  # spacing of the distances to what does not move, m
MOST = 1024  # largest number of these distances along a side
LIMIT = 1.0  # largest of these distances, m
MARGIN = 0.015  # distance added to the discs that cover the robot, m
NEAR = 1.5  # distance to the goal below which the way to it is straight, m
INSIDE = 0.9  # part of the goal's radius that counts as the goal in a plan
NO_PATH = 20.0  # cost of places from which no path leads to the goal, s
_AWAY = 1e6  # coordinate of movers that do not exist, m


class _Memory(NamedTuple):
    """Plans of all rows: costs to go, x and y of their windows, the goals, and the step of the plan (-1: none)."""

    costs: Tensor
    origin: Tensor
    goal: Tensor
    step: Tensor
    action: Tensor


class _Place(NamedTuple):
    """Where a policy drives. A tuple, so that the environment, a module, does not become a part of the policy."""

    env: RoverEnv
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
        from rover_rl.algos.policy.foresight_kernels import LAYERS, SIZE

        rows, device = env.num_envs, env.placement.bounds.device
        self._place = _Place(
            env, PathDistances(env.pool, self._robot, device, CAUTION), FixedDistances(env.pool, device)
        )
        pair = torch.zeros(rows, 2, device=device)
        step = torch.full((rows,), -1, dtype=torch.int64, device=device)
        costs = torch.zeros(rows, int(LAYERS) + 1, int(SIZE) ** 2, device=device)
        self._memory = _Memory(costs, pair, pair, step, pair)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Sets ``action [N, 2]``. Raises ``RuntimeError`` before :meth:`enter`."""
        if self._place is None:
            raise RuntimeError("foresight knows no environment: drive it with PolicyRunner(policy, env=env)")
        env = self._place.env
        # A runner adds copies of the last row to few rows.
        rows = tensordict[: env.num_envs]
        steps, goal, memory = rows["outcome", "steps"][:, 0], env.goal, self._memory
        age = steps - memory.step
        changed = (age < 0) | (memory.step < 0) | (goal != memory.goal).any(-1)
        due = changed | (steps % DECIDE == 0)
        world = world_of(rows)[:, 0]
        self._plan(changed | (due & (age >= REPLAN)), steps, goal, world)
        self._decide(due, steps, world, rows["velocities"])
        action = self._memory.action
        extra = action.new_zeros(len(tensordict) - len(rows), 2)
        return tensordict.set("action", torch.cat((action, extra)))

    def _plan(self, rows: Tensor, steps: Tensor, goal: Tensor, world: Tensor) -> None:
        """Computes the costs to go of ``rows``, bool ``[N]``."""
        from rover_rl.algos.policy import foresight_kernels as kernels

        chosen = rows.nonzero().squeeze(-1)
        if not len(chosen):
            return
        place, memory = self._entered, self._memory
        env = place.env
        size, cell = int(kernels.SIZE), float(kernels.CELL)
        origin = env.rover_state.position[:, :2] - size // 2 * cell
        memory = memory._replace(
            origin=torch.where(rows[:, None], origin, memory.origin),
            goal=torch.where(rows[:, None], goal, memory.goal),
            step=torch.where(rows, steps, memory.step),
        )
        self._memory = memory
        grid = torch.arange(size, device=origin.device) * cell
        offsets = torch.stack((grid.repeat(size), grid.repeat_interleave(size)), -1)
        fields = place.paths.fields(world[chosen], goal[chosen])
        points = memory.origin[chosen, None] + offsets
        length, is_free = place.paths.along(fields, points)
        straight = (points - goal[chosen, None]).norm(dim=-1)
        length = torch.where(straight < NEAR, straight, length)
        speed = self._speed
        last = int(kernels.LAYERS)
        memory.costs[chosen, last] = torch.where(is_free, length / speed, straight / speed + NO_PATH)
        moving = moving_at(env.movers, [layer * self._layer_dt for layer in range(last)])
        radius = INSIDE * env.task.success_distance
        inputs = [_pairs(memory.origin), _pairs(memory.goal), radius, speed, self._layer_dt]
        inputs += [place.fixed.struct(world), moving]
        for layer in reversed(range(last)):
            _launch(kernels.sweep, (len(chosen), size * size), [chosen, layer, *inputs, memory.costs], origin.device)

    def _decide(self, rows: Tensor, steps: Tensor, world: Tensor, velocities: Tensor) -> None:
        """Decides on the actions of ``rows``, bool ``[N]``."""
        from rover_rl.algos.policy import foresight_kernels as kernels

        chosen = rows.nonzero().squeeze(-1)
        if not len(chosen):
            return
        place, memory = self._entered, self._memory
        env = place.env
        rover, device = env.rover_state, memory.costs.device
        yaw = quaternion_to_euler(rover.orientation)[:, 2:]
        states = torch.cat((rover.position[:, :2], yaw, velocities[:, :1], velocities[:, 1:] * self._gain), -1)
        instants = [number * float(kernels.DRIVE_DT) for number in range(int(kernels.FIRST) + int(kernels.SECOND) + 1)]
        turns, speeds = int(kernels.TURNS), int(kernels.SPEEDS)
        results = torch.zeros(len(states), speeds * turns, device=device)
        since = ((steps - memory.step) * env.control_dt).float()
        inputs = [chosen, since, self._layer_dt, states.contiguous(), _pairs(memory.origin), _pairs(memory.goal)]
        inputs += [0.97 * env.task.success_distance, self._body(), place.fixed.struct(world)]
        inputs += [moving_at(env.movers, instants), memory.costs, results]
        _launch(kernels.drive, (len(chosen), speeds * turns), inputs, device)
        best = results.argmin(-1)
        speed = self._speed * (2 * (best // turns) / (speeds - 1) - 1)
        yaw_rate = MAX_YAW_RATE * (2 * (best % turns) / (turns - 1) - 1)
        # The heading PID commands the wheels to turn at kp times a constant heading offset.
        offset = (yaw_rate / (self._gain * HeadingGains.kp)).clamp(-math.pi, math.pi)
        action = torch.stack((speed, offset), -1).to(memory.action)
        self._memory = memory._replace(action=torch.where(rows[:, None], action, memory.action))

    @property
    def _entered(self) -> _Place:
        assert self._place is not None
        return self._place

    @property
    def _speed(self) -> float:
        env = self._entered.env.config
        return min(self._robot.drive.max_speed, action_bounds(env.bounded_action).high[0])

    @property
    def _layer_dt(self) -> float:
        """Time from one instant of a plan to the next, in which a rover moves ``LAYER_WAY`` at most, s.

        With a longer way, it would leave the window within a plan, and it would not matter when it starts.
        """
        return min(LAYER_DT, LAYER_WAY / self._speed)

    def _body(self) -> Any:
        """Returns what a drive depends on of the robot, as the kernels read it."""
        from rover_rl.algos.policy.foresight_kernels import Body

        body, drive = Body(), self._robot.drive
        centers, radius = covering_discs(self._robot, EXCESS)
        # Two discs, or those at the ends of more.
        body.front, body.radius = float(np.abs(centers).max()), radius + MARGIN
        body.speed, body.acceleration = self._speed, drive.max_linear_acceleration
        body.yaw_acceleration, body.yaw_rate = drive.max_angular_acceleration * self._gain, MAX_YAW_RATE
        body.turning = drive.min_radius(self._robot.wheels)
        return body


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
        from rover_rl.algos.policy.foresight_kernels import Fixed
        from rover_rl.sims.native.warp import wp

        if missing := [index for index in world.unique().tolist() if index not in self._slots]:
            for index in missing:
                self._slots[index] = len(self._grids)
                self._grids.append(_clearance(self._worlds[index]))
            clearance, frames = zip(*self._grids, strict=True)
            self._clearance = pad_sequence(list(clearance), batch_first=True).to(self._device)
            self._frames = torch.stack(frames).to(self._device)
        slots = torch.tensor([self._slots[index] for index in world.tolist()], device=world.device)
        fixed = Fixed()
        fixed.world, fixed.frame = wp.from_torch(slots), wp.from_torch(self._frames)
        fixed.clearance = wp.from_torch(self._clearance)
        return fixed


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
    from rover_rl.algos.policy.foresight_kernels import Moving
    from rover_rl.sims.native.warp import wp

    poses = []
    for later in map(movers.ahead, seconds):
        place = later.position.masked_fill(~movers.present[..., None], _AWAY)
        poses.append(torch.cat((place, later.yaw.cos()[..., None], later.yaw.sin()[..., None]), -1))
    moving = Moving()
    moving.pose = wp.from_torch(torch.stack(poses, 1).float().contiguous(), dtype=wp.vec4)
    moving.form = wp.from_torch(_forms(movers), dtype=wp.vec3)
    return moving


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


def _pairs(values: Tensor) -> Any:
    from rover_rl.sims.native.warp import wp

    return wp.from_torch(values.float().contiguous(), dtype=wp.vec2)


def _launch(kernel: Any, dim: tuple[int, ...], inputs: list[Any], device: torch.device) -> None:
    """Launches a kernel, in Torch's stream on a GPU."""
    from rover_rl.sims.native.warp import wp

    stream = wp.stream_from_torch(device) if device.type == "cuda" else None
    wp.launch(kernel, dim, inputs, device=wp.device_from_torch(device), stream=stream)
