"""Digests of rollouts, evaluations and trainings, to compare two revisions to the last bit.

Run it on both revisions, on the same machine, and compare the lines::

    python -m benchmarks.digests > after.txt
    git worktree add ../before REVISION && (cd ../before && python -m benchmarks.digests) > before.txt
    diff before.txt after.txt

Rollouts take 200 random steps of 16 rovers in each world and simulator, with and without randomization. Evaluations
drive the package's policies on stored start-goal pairs; their digests cover all metrics, without confidence intervals,
and every episode. Trainings are short runs of PPO and SAC in both simulators; their digests cover the policy's weights.
"""

from __future__ import annotations

import hashlib
import json
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from itertools import product
from tempfile import TemporaryDirectory

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor

from benchmarks.stored import stored_worlds
from rover_rl import Randomization, make_env
from rover_rl.algos.config import training_config
from rover_rl.algos.evaluation.episodes import STORED_WORLDS, stored_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.pretrained import load_pretrained, pretrained_names
from rover_rl.algos.train import train

ROVERS, STEPS = 16, 200
BACKENDS = ("bullet", "warp")


@dataclass(frozen=True)
class Digests:
    """Print digests of rollouts, evaluations and trainings, to compare two revisions to the last bit."""

    count: int = 64
    """Number of stored episodes that each policy drives."""

    def __call__(self) -> None:
        """Prints one line per rollout, evaluation and training."""
        torch.set_num_threads(1)
        for world, backend, noise in product(STORED_WORLDS, BACKENDS, (None, Randomization.typical())):
            name = "randomized" if noise else "plain"
            print("rollout", world, backend, name, rollout_digest(world, backend, noise), flush=True)
        for name in pretrained_names():
            print("evaluation", name, *evaluation_digest(name, self.count), flush=True)
        for algo, backend in product(("ppo", "sac"), BACKENDS):
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


def evaluation_digest(name: str, count: int) -> tuple[str, float]:
    """Digest of an evaluation, and its success rate."""
    checkpoint = load_pretrained(name)
    world, *_ = stored_worlds(checkpoint.env)
    result = evaluate(checkpoint.make_actor(), stored_episodes(world).first(count), name=name)
    values = {key: metric.value for key, metric in result.metrics.items()}
    text = json.dumps([values, result.to_json()["episodes"]], sort_keys=True)
    paths = {str(number): path for number, path in enumerate(result.paths)}
    return hashlib.sha256((text + digest(paths)).encode()).hexdigest()[:16], result.success_rate


def training_digest(algo: str, backend: str) -> str:
    # The progress of a training does not belong to the digests.
    with TemporaryDirectory() as runs, redirect_stdout(sys.stderr):
        settings = {"world": "moon", "total_steps": 8192, "num_envs": ROVERS, "seed": 5, "workers": 1}
        summary = train(training_config(algo, **settings, backend=backend, runs=runs))
        return digest(Checkpoint.load(summary.checkpoint).actor)


def digest(tensors: dict[str, Tensor]) -> str:
    """Hash of the names and bytes of tensors."""
    result = hashlib.sha256()
    for name in sorted(tensors):
        result.update(name.encode() + tensors[name].detach().contiguous().numpy().tobytes())
    return result.hexdigest()[:16]


if __name__ == "__main__":
    tyro.cli(Digests)()
