"""Data is collected in worker processes, and in one process as by TorchRL's collector, to the last bit."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import (
    Compose,
    EnvBase,
    RandomTruncationTransform,
    StepCounter,
    TensorDictPrimer,
    Transform,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs
from torchrl.modules import GRUModule, TanhNormal

from rover_rl import RoverEnv
from rover_rl.algos.config import UNLIMITED_STEPS, TrainingConfig
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import BoundedTanhNormal
from rover_rl.algos.policy.recurrent import GRU as GRUStep
from rover_rl.algos.policy.recurrent import MemoryPrimer, memory_transforms, state_keys
from rover_rl.algos.train.attempts import SpreadEnds
from rover_rl.algos.train.collectors import WorkerError, collect
from rover_rl.algos.train.env import make_training_env
from rover_rl.algos.train.run import prepare
from tests.algos.train.runs import (
    BOTH,
    FIELD,
    GRU,
    LEARNABLE,
    LEARNERS,
    LSTM,
    PPO,
    SAC,
    before_updates,
    progress_of,
    run,
    state_of,
)


@pytest.mark.slow
def test_two_workers_share_the_rovers(tmp_path: Path) -> None:
    # The only test whose workers start as those of a user: each with a new interpreter.
    assert progress_of(run(PPO, tmp_path, workers=2, total_steps=128).folder)["steps"] == [64, 128]


@pytest.mark.slow
@pytest.mark.usefixtures("quick_workers")
def test_sac_learns_from_one_worker_while_the_other_collects(tmp_path: Path) -> None:
    progress = progress_of(run(SAC, tmp_path, workers=2).folder)
    # Each batch holds two decisions of the two rovers of one worker, followed by half of the gradient steps.
    assert progress["steps"] == list(range(16, 257, 16))
    assert progress["gradient_steps"] == [0.0] * 5 + [1.0] * 11


@pytest.fixture
def workers(quick_workers: None) -> Iterator[set[BaseProcess]]:
    """Processes that run before the test; afterwards there are no others."""
    before = set(multiprocessing.active_children())
    yield before
    assert not set(multiprocessing.active_children()) - before


@BOTH
@pytest.mark.slow
def test_a_crashed_worker_ends_the_run_with_a_checkpoint_and_its_output(
    config: TrainingConfig, workers: set[BaseProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(number: int, *_: object) -> None:
        if number == 3:
            worker = next(iter(set(multiprocessing.active_children()) - workers))
            assert worker.pid is not None
            os.kill(worker.pid, signal.SIGSEGV)

    before_updates(monkeypatch, config.algo, kill)
    with pytest.raises(WorkerError, match=r"(?s)exit code -11.*Fatal Python error: Segmentation fault"):
        run(config, tmp_path, workers=2, total_steps=UNLIMITED_STEPS, name="dying")
    folder = tmp_path / "dying"
    assert 3 <= state_of(folder)["updates"] == len(progress_of(folder)["updates"])
    monkeypatch.undo()
    steps = Checkpoint.load(folder).steps + 128
    assert run(config, tmp_path, folder, workers=2, total_steps=steps, name="dying").steps == steps


@BOTH
@pytest.mark.slow
@pytest.mark.usefixtures("quick_workers")
def test_an_error_of_a_worker_is_reported(
    config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The world is not checked before the workers start.
    monkeypatch.setattr("rover_rl.algos.train.run.check_world", lambda world: None)
    with pytest.raises((WorkerError, ValueError), match="unknown world 'mars'"):
        run(config, tmp_path, world="mars", workers=2)


# --- one process

CONFIGS = {"sac": SAC, "curriculum": LEARNABLE, "gru": GRU, "lstm": LSTM}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_batches_are_those_of_a_collector(config: TrainingConfig) -> None:
    own, others = _own_batches(config), _batches_of_a_collector(config)
    assert any(batch["next", "done"][:, :-1].any() for batch in own) or config is SAC
    for batch, other in zip(own, others, strict=True):
        assert batch.shape == (config.num_envs, config.algorithm.rollout_length)
        assert _entries(batch).keys() == _entries(other).keys()
        for key, value in _entries(batch).items():
            assert torch.equal(value, _entries(other)[key]), key


def _own_batches(config: TrainingConfig) -> list[TensorDictBase]:
    config = prepare(config)
    with collect(config, LEARNERS[config.algo](config).actor) as batches:
        return [next(batches) for _ in range(3)]


def _batches_of_a_collector(config: TrainingConfig) -> list[TensorDictBase]:
    config = prepare(config)
    actor = LEARNERS[config.algo](config).actor
    collector = Collector(
        make_training_env(config),
        actor,
        frames_per_batch=config.num_envs * config.algorithm.rollout_length,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
    batches = iter(collector)
    try:
        return [next(batches) for _ in range(3)]
    finally:
        collector.shutdown()


def _entries(batch: TensorDictBase) -> dict[str, Tensor]:
    """All entries except for the times."""
    return {str(key): value for key, value in batch.items(True, True) if "clock" not in key}


def _ended(transform: Transform) -> TensorDictBase:
    """Some episodes of rovers that stand still."""
    env = RoverEnv(world_n=FIELD, num_envs=4, seed=0)
    torch.manual_seed(0)
    env = TransformedEnv(env, Compose(StepCounter(), transform))
    return env.rollout(24, lambda td: td.set("action", torch.zeros(4, 2)), break_when_any_done=False)


def test_episodes_end_as_with_the_transform_of_torchrl() -> None:
    own, other = _ended(SpreadEnds(9)), _ended(RandomTruncationTransform(1, 9))
    assert own["next", "truncated"].any(1).all()
    for key in ("step_count", ("next", "step_count"), ("next", "truncated"), ("next", "done")):
        assert torch.equal(own[key], other[key]), key


def _with_memory(primer: type[TensorDictPrimer]) -> EnvBase:
    env: EnvBase = RoverEnv(world_n=FIELD, num_envs=3, seed=0)
    tracker, own = memory_transforms("gru", 4)
    return env.append_transform(tracker).append_transform(primer(own.primers, expand_specs=True))


def test_the_memory_begins_as_with_the_transform_of_torchrl() -> None:
    mask = torch.tensor([[True], [False], [True]])
    resets = []
    for primer in (MemoryPrimer, TensorDictPrimer):
        env = _with_memory(primer)
        check_env_specs(env)
        td = env.reset()
        td["memory_hidden"] = torch.ones(3, 1, 4)
        resets.append(env.reset(td.set("_reset", mask)))
    for key in ("memory_hidden", "is_init"):
        assert torch.equal(resets[0][key], resets[1][key])
    assert resets[0]["memory_hidden"].flatten(1).sum(1).tolist() == [0, 4, 0]


@pytest.mark.parametrize("shape", [(), (5,), (5, 2)])
def test_a_step_of_a_memory_is_that_of_torchrl(shape: tuple[int, ...]) -> None:
    keys = {"in_keys": ["embedding", "memory", "is_init"], "out_keys": ["recalled", ("next", "memory")]}
    own, other = GRUStep(6, 4, **keys), GRUModule(6, 4, **keys)
    other.load_state_dict(own.state_dict())
    assert state_keys(own) == ["memory"]
    entries = {"embedding": torch.randn(*shape, 6), "memory": torch.randn(*shape, 1, 4)}
    td = TensorDict({**entries, "is_init": torch.rand(*shape, 1) < 0.5}, shape)
    for given in (td, td.exclude("memory")):
        after, expected = own(given.clone()), other(given.clone())
        for key in ("recalled", ("next", "memory")):
            assert torch.equal(after[key], expected[key])


def test_a_distribution_is_that_of_torchrl() -> None:
    bounds = {"low": torch.tensor([-1.0, -3.0]), "high": torch.tensor([1.0, 2.0])}
    loc, scale = torch.randn(6, 2, requires_grad=True), torch.rand(6, 2) + 0.1
    results = []
    for kind in (BoundedTanhNormal, TanhNormal):
        torch.manual_seed(0)
        distribution = kind(loc, scale, **bounds)
        action, log_prob = distribution.rsample_and_log_prob()
        other = distribution.log_prob(distribution.sample())
        (slope,) = torch.autograd.grad((action.sum() + log_prob.sum() + other.sum()), loc)
        results.append((action, log_prob, other, slope, distribution.deterministic_sample))
    for own, expected in zip(*results, strict=True):
        assert torch.equal(own, expected)
