"""Training on a Ray cluster of two nodes on this machine, with one processor each."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from rover_rl.algos.config import UNLIMITED_STEPS, with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train import train
from rover_rl.algos.train.collectors import WorkerError
from rover_rl.algos.train.ppo import PPOLearner
from rover_rl.algos.train.run_folder import load_state
from tests.algos.train import runs
from tests.algos.train.memories import check_states, joined, kept_batches
from tests.algos.train.runs import progress_of

PPO = with_settings(runs.PPO, collector="ray", workers=None)
SAC = with_settings(runs.SAC, collector="ray", workers=None)


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'rover_rl[ray]'")
    from ray.cluster_utils import Cluster

    # Ray gives its workers a low priority; beside other tests they would hardly start.
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112, as Ray spells it
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    nodes.add_node(num_cpus=1)
    nodes.wait_for_nodes()
    os.environ["RAY_ADDRESS"] = nodes.address
    yield
    del os.environ["RAY_ADDRESS"], os.environ["RAY_worker_niceness"]  # noqa: SIM112
    ray.shutdown()
    nodes.shutdown()


def remote_workers() -> list[psutil.Process]:
    """Ray's processes with a collector of ours."""
    words = {process: " ".join(_words(process)) for process in psutil.process_iter()}
    return [process for process, said in words.items() if "ray::" in said and "Collector" in said]


def _words(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []


@pytest.mark.slow
def test_sac_learns_from_one_worker_while_the_other_collects(cluster: None, tmp_path: Path) -> None:
    progress = progress_of(train(with_settings(SAC, total_steps=128, runs=str(tmp_path))).folder)
    assert progress["steps"] == list(range(16, 129, 16))


@pytest.mark.slow
def test_remote_workers_carry_the_memory_and_have_a_curriculum_of_their_own(
    cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    collected = kept_batches(monkeypatch)
    memory = {"memory": "gru", "memory_size": 8, "rollout_length": 8, "minibatch": 16}
    config = with_settings(runs.LEARNABLE, **memory, collector="ray", workers=2, total_steps=384, runs=str(tmp_path))
    folder = train(config).folder
    assert len(collected) == 3
    check_states(joined(collected), "gru")
    assert train(with_settings(config, total_steps=512), folder).steps == 512
    record = (folder / "curriculum.csv").read_text().splitlines()
    assert sum(int(row.split(",")[1]) for row in record[1:]) >= 8


def kill_a_worker_at_the_third_update(monkeypatch: pytest.MonkeyPatch, wait: float) -> None:
    """Lets PPO kill a worker and wait for some seconds."""
    update, calls = PPOLearner.update, []

    def killing(self: Any, *args: Any) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 3:
            remote_workers()[0].send_signal(signal.SIGKILL)
            time.sleep(wait)
        return update(self, *args)

    monkeypatch.setattr(PPOLearner, "update", killing)


@pytest.mark.slow
def test_ppo_takes_the_same_steps_as_on_one_machine_also_if_a_worker_was_killed(
    cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kill_a_worker_at_the_third_update(monkeypatch, wait=0)
    with pytest.raises(WorkerError, match="actor died"):
        train(with_settings(PPO, total_steps=UNLIMITED_STEPS, runs=str(tmp_path), name="dying"))
    folder = tmp_path / "dying"
    assert load_state(folder / "training_state.pt")["updates"] >= 3
    monkeypatch.undo()
    steps = Checkpoint.load(folder).steps
    again = train(with_settings(PPO, total_steps=steps + 128, runs=str(tmp_path), name="dying"), folder)
    assert again.steps == steps + 128
    assert progress_of(folder)["steps"] == list(range(64, steps + 129, 64))
    assert sum(again.shares.values()) == pytest.approx(1)
    # One worker per processor of the cluster.
    assert "workers: 2" in (folder / "config.yaml").read_text()
    assert not remote_workers()


@pytest.mark.slow
def test_a_run_in_warp_ends_resumably_if_a_worker_was_killed_a_while_ago(
    cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = with_settings(PPO, backend="warp", runs=str(tmp_path), name="dying")
    kill_a_worker_at_the_third_update(monkeypatch, wait=2)
    with pytest.raises(WorkerError, match="actor died"):
        train(with_settings(config, total_steps=UNLIMITED_STEPS))
    folder = tmp_path / "dying"
    assert load_state(folder / "training_state.pt")["updates"] >= 3
    monkeypatch.undo()
    checkpoint = Checkpoint.load(folder)
    assert (checkpoint.env.backend, checkpoint.env.num_envs) == ("warp", PPO.num_envs)
    steps = checkpoint.steps
    # Without the cluster, whose workers take seconds to start.
    config = with_settings(config, collector="auto", workers=1, total_steps=steps + 64)
    assert train(config, folder).steps == steps + 64
    assert progress_of(folder)["steps"] == list(range(64, steps + 65, 64))


@pytest.mark.slow
def test_more_workers_than_processors_raise(cluster: None, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="workers=4 need a processor each, and the Ray cluster has 2"):
        train(with_settings(PPO, workers=4, runs=str(tmp_path)))
    assert not list(tmp_path.iterdir())


def test_without_ray_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r'pip install "rover_rl\[ray\]"'):
        train(with_settings(PPO, runs=str(tmp_path)))
    assert not list(tmp_path.iterdir())
