"""Digests of rollouts, evaluations and trainings, to compare two revisions to the last bit.

Run it on both revisions, on the same machine, and compare the lines::

    python -m benchmarks.digests > after.txt
    git worktree add ../before REVISION && (cd ../before && python -m benchmarks.digests) > before.txt
    diff before.txt after.txt

Rollouts take 200 random steps of 16 rovers in each world and simulator, with and without randomization, and in pools
of unseen worlds. Evaluations drive the package's policies on stored start-goal pairs, and the baselines in unseen
worlds: their digests cover all metrics and episodes. Those of short trainings by PPO and SAC cover the weights.
"""

from __future__ import annotations

import hashlib
import json
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from itertools import product
from tempfile import TemporaryDirectory
from typing import Literal, TypeAlias, get_args

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor

from rover_rl import Randomization, make_env
from rover_rl.algos.config import training_config
from rover_rl.algos.evaluation.episodes import STORED_WORLDS, draw_episodes, stored_episodes
from rover_rl.algos.evaluation.evaluate import environment_for, evaluate
from rover_rl.algos.evaluation.results import Evaluation
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.names import BASELINES, make_baseline
from rover_rl.algos.pretrained import load_pretrained, pretrained_names
from rover_rl.algos.train import train
from rover_rl.envs.config import EnvConfig
from rover_rl.names import Name

ROVERS, STEPS = 16, 200
BACKENDS = ("bullet", "warp", "mujoco")
RANDOMIZED = Randomization(
    friction=(0.7, 1.3),
    chassis_mass=(0.9, 1.3),
    motor_torque=(0.7, 1.0),
    latency=(0, 2),
    range_noise=0.01,
    dropout=0.01,
    odometry_noise=0.02,
    imu_noise=0.01,
)
"""Stated here, so that other typical ranges do not change the digests."""
POOLS = ("maze:50000-50063", "forest:50000-50063", "hills:50000-50063")
Part: TypeAlias = Literal["rollouts", "pools", "policies", "baselines", "trainings"]


@dataclass(frozen=True)
class Options:
    """Print digests of rollouts, evaluations and trainings, to compare two revisions to the last bit."""

    count: int = 64
    """Number of stored episodes that each policy drives."""
    parts: tuple[Part, ...] = get_args(Part)
    """What to run."""
    worlds: tuple[str, ...] = STORED_WORLDS
    """Worlds of the rollouts, each with and without randomization."""
    backends: tuple[str, ...] = BACKENDS
    """Simulators of the rollouts."""

    def __call__(self) -> None:
        torch.set_num_threads(1)
        if "rollouts" in self.parts:
            for world, backend, noise in product(self.worlds, self.backends, (None, RANDOMIZED)):
                name = "randomized" if noise else "plain"
                print("rollout", world, backend, name, rollout_digest(world, backend, noise), flush=True)
        if "pools" in self.parts:
            for world in POOLS:
                print("pool", world, rollout_digest(world, "warp", RANDOMIZED), flush=True)
        if "policies" in self.parts:
            for name in stored_policies():
                print("policy", name, *policy_digest(name, self.count), flush=True)
        if "baselines" in self.parts:
            for name in BASELINES:
                print("baseline", name, *baseline_digest(name), flush=True)
        if "trainings" in self.parts:
            for algo, backend in product(("ppo", "sac"), ("bullet", "warp")):
                print("training", algo, backend, training_digest(algo, backend), flush=True)


def rollout_digest(world: str, backend: str, randomization: Randomization | None) -> str:
    env = make_env(world_n=world, num_envs=ROVERS, seed=7, backend=backend, randomization=randomization)
    generator = torch.Generator().manual_seed(3)

    def policy(td: TensorDictBase) -> TensorDictBase:
        action = torch.rand(ROVERS, 2, generator=generator) * 2 - torch.tensor([0.6, 1.0])
        return td.set("action", action)

    rollout = env.rollout(STEPS, policy, break_when_any_done=False)
    env.close()
    return digest({str(key): value for key, value in rollout.items(True, True)})


def stored_worlds(env: EnvConfig) -> list[str]:
    """Returns the worlds with stored starts and goals among those of a training; for a range, the world of its kind."""
    names = map(Name.parse, env.world_names)
    kinds = dict.fromkeys(name.part if name.is_range else str(name) for name in names)
    return [kind for kind in kinds if kind in STORED_WORLDS]


def stored_policies() -> list[str]:
    """Returns the pretrained policies that were trained in a world with stored starts and goals."""
    return [name for name in pretrained_names() if stored_worlds(load_pretrained(name).env)]


def policy_digest(name: str, count: int) -> tuple[str, float]:
    checkpoint = load_pretrained(name)
    world, *_ = stored_worlds(checkpoint.env)
    return evaluation_digest(evaluate(checkpoint.make_actor(), stored_episodes(world).first(count), name=name))


def baseline_digest(name: str) -> tuple[str, float]:
    policy = make_baseline(name)
    env = replace(environment_for(policy, None), backend="warp")
    return evaluation_digest(evaluate(policy, draw_episodes("maze:50000-50015", 1), name=name, env=env))


def evaluation_digest(result: Evaluation) -> tuple[str, float]:
    """Digest of an evaluation, and its success rate."""
    values = {key: metric.value for key, metric in result.metrics.items()}
    text = json.dumps([values, result.to_json()["episodes"]], sort_keys=True)
    paths = {str(number): path for number, path in enumerate(result.paths)}
    return hashlib.sha256((text + digest(paths)).encode()).hexdigest()[:16], values["success_rate"]


def training_digest(algo: str, backend: str) -> str:
    # The progress of a training does not belong to the digests.
    with TemporaryDirectory() as runs, redirect_stdout(sys.stderr):
        settings = {"world": "moon", "total_steps": 8192, "num_envs": ROVERS, "seed": 5, "workers": 1}
        summary = train(training_config(algo, **settings, backend=backend, runs=runs))
        return digest(Checkpoint.load(summary.checkpoint).actor)


def digest(tensors: dict[str, Tensor]) -> str:
    result = hashlib.sha256()
    for name in sorted(tensors):
        result.update(name.encode() + tensors[name].detach().contiguous().numpy().tobytes())
    return result.hexdigest()[:16]


if __name__ == "__main__":
    tyro.cli(Options)()
