"""Batches and updates on the CPU and on a simulated accelerator, which test_accelerator.py compares."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl import make_env
from rover_rl.algos.config import TrainingConfig, training_config, with_settings
from rover_rl.algos.evaluation.cores import dumps
from rover_rl.algos.train.collectors import collect
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.progress import Stopwatch
from rover_rl.algos.train.sac import SACLearner
from rover_rl.envs.config import Randomization
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.path_reward import PathReward
from rover_rl.robots import Robot
from rover_rl.robots.fleet import Fleet, MassTable
from rover_rl.sims import RoverState, Simulator
from rover_rl.sims.free_space import rest_on_ground
from rover_rl.sims.rover_state import Dynamics, SimulatedDrives
from rover_rl.sims.settings import Connection
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.pool import WorldPool
from rover_rl.worlds.table import TerrainTable, WorldTable
from tests.accelerator import Accelerator, accelerator
from tests.algos.train.runs import FIELD, WALL

ROVERS = 6
WORLDS = (FIELD, WALL)
POOL = WorldPool(*(World(f"field {k}", Terrain.flat((6.0 + k, 6.0))) for k in range(4)))
"""As many worlds as rovers at most, so that all of them stay on the device."""


class SlidingBackend:
    """Rovers that follow their commands exactly, without collisions, on any device.

    They see how long the terrain of their world is, and can change worlds. Their poses and masses are those of Warp's.
    """

    def make(
        self,
        *,
        worlds: Sequence[World],
        robot: Robot,
        connection: Connection | None = None,
        device: torch.device | None = None,
    ) -> SlidingSimulator:
        return SlidingSimulator(worlds, robot, device or torch.device("cpu"))


class SlidingSimulator(Simulator):
    features = frozenset({"dynamics", "lidar", "worlds"})

    def __init__(self, worlds: Sequence[World], robot: Robot, device: torch.device) -> None:
        self.num_envs = count = len(worlds)
        self.device = device
        self.control_dt = 0.05
        self._drive = SimulatedDrives(Fleet.of(robot, count, device), 0.05)
        self._pose = torch.zeros(count, 3, device=device)
        self._height = torch.zeros(count, 1, device=device)
        self._robot, self._masses = robot, MassTable([robot], device)
        self._worlds = WorldTable.of(worlds, device)
        self._entered = self._worlds.follow()
        self._terrains = TerrainTable(device)
        self._lengths = torch.zeros(self._worlds.capacity, 1, device=device)
        self.enter_worlds()

    def enter_worlds(self) -> None:
        for slot, world in self._entered().items():
            self._terrains[slot], self._lengths[slot] = world.terrain, world.bounds[0][1]
        slots = self._worlds.slots
        self._ground, self._length = self._terrains.of(slots), self._lengths[slots]

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        self._pose = torch.where(mask[:, None], poses, self._pose)
        height = rest_on_ground(self._ground, self._robot, poses)[0][:, 2:].float()
        self._height = torch.where(mask[:, None], height, self._height)
        self._drive.reset(mask)
        return self.state()

    def set_dynamics(self, mask: Tensor, dynamics: Dynamics) -> None:
        index = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        mass, _, _ = self._masses.total(self._masses.chassis_mass * dynamics.chassis_mass.double(), index)
        self._height = torch.where(mask[:, None], mass[:, None].float(), self._height)

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        self._drive.advance(commands, active)
        x, y, yaw = self._pose.split(1, -1)
        speed, turn = commands.split(1, -1)
        moved = torch.cat((x + 0.05 * speed * yaw.cos(), y + 0.05 * speed * yaw.sin(), yaw + 0.05 * turn), -1)
        self._pose = moved if active is None else torch.where(active[:, None], moved, self._pose)
        return self.state()

    def state(self) -> RoverState:
        x, y, yaw = self._pose.split(1, -1)
        zero = torch.zeros_like(x)
        body = torch.cat((x, y, self._height, zero, zero, (yaw / 2).sin(), (yaw / 2).cos(), zero, zero), -1)
        return self._drive.state(body)

    def scanner(self, beams: int) -> SlidingScanner:
        return SlidingScanner(self, beams)

    def ranges(self, angles: Tensor) -> Tensor:
        return 0.4 * self._length + (3 * angles + self._pose[:, 2:]).cos()

    def close(self) -> None: ...


class SlidingScanner:
    def __init__(self, simulator: SlidingSimulator, beams: int) -> None:
        self.angles = torch.arange(beams, device=simulator.device) * (2 * math.pi / beams)
        self._simulator = simulator

    def scan(self, rows: Tensor | None = None) -> Tensor:
        return self._simulator.ranges(self.angles)


LEARNERS = {
    "ppo": training_config("ppo", epochs=2),
    "sac": training_config("sac", gradient_steps=2, learning_starts=8, buffer_size=64),
}


COLLECTED = {"sac": LEARNERS["sac"], "pool": training_config("ppo", world=POOL)}
"""Trainings whose actors collect batches."""


def on_both() -> bytes:
    """Observations, batches and updates on an accelerator and on the CPU, and the operations that wait for the former.

    They are pickled by value, because PyTorch's own pickles would need thousands of open files.
    """
    with accelerator() as on:
        there = _found(on)
    # The accelerator would also look at each operation on the CPU, which takes a third of the time.
    here = _found(None)
    return dumps({name: (part, here[name]) for name, part in there.items()})


def _found(on: Accelerator | None) -> dict[str, Any]:
    learned = {name: _learned(on, config) for name, config in LEARNERS.items()}
    return learned | {f"batches of {name}": _collected(on, config) for name, config in COLLECTED.items()}


def _learned(on: Accelerator | None, config: TrainingConfig) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Statistics of the second update, and the weights after it."""
    config = _small(on, config)
    torch.manual_seed(0)
    learner: Any = (PPOLearner if config.algo == "ppo" else SACLearner)(config)
    env = _env(on).append_transform(ActionRepeat(2))
    env = env.append_transform(PathReward(env.base_env, 1.0))
    for _ in range(2):
        with set_exploration_type(ExplorationType.RANDOM), torch.no_grad():
            batch = env.rollout(config.algorithm.rollout_length, learner.actor, break_when_any_done=False)
        told = learner.update(batch, 0.0, Stopwatch())
    learner.load_state_dict(learner.state_dict())
    return told, {name: value.detach().to("cpu") for name, value in learner.actor.state_dict().items()}


def _collected(on: Accelerator | None, config: TrainingConfig) -> tuple[list[dict[str, Tensor]], list[str]]:
    """Three batches of a training, and the operations that waited for the accelerator in the last two."""
    settings = {"action_repeat": 2, "length": 12, "seed": 3, "randomization": Randomization.typical()}
    config = with_settings(_small(on, config), backend=SlidingBackend(), **settings)
    torch.manual_seed(0)
    learner: Any = (PPOLearner if config.algo == "ppo" else SACLearner)(config)
    seen, looks = [], []
    with collect(config, learner.actor) as batches:
        for number in range(3):
            if on is not None:
                on.looks.clear()
            batch = next(batches)
            if on is not None and number > 0:
                looks += on.looks
            seen.append(_on_host(batch))
    return seen, looks


def _small(on: Accelerator | None, config: TrainingConfig) -> TrainingConfig:
    return with_settings(
        config,
        world=POOL if config.env.world is POOL else WORLDS,
        num_envs=ROVERS,
        workers=1,
        rollout_length=4,
        minibatch=12,
        hidden=(16,),
        device="cpu" if on is None else str(on.device),
    )


def _env(on: Accelerator | None) -> TransformedEnv:
    return make_env(
        world_n=WORLDS,
        num_envs=ROVERS,
        length=12,
        backend=SlidingBackend(),
        randomization=Randomization.typical(),
        seed=0,
        device=None if on is None else on.device,
    )


def _on_host(data: TensorDictBase) -> dict[str, Tensor]:
    return {str(key): value.to("cpu") for key, value in data.items(True, True)}
