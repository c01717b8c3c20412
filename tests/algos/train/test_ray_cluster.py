"""Training on a Ray cluster of one node on this machine, with two processors."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from tensordict import TensorDictBase

from rover_rl.algos.config import UNLIMITED_STEPS, with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.train.collectors import WorkerError
from rover_rl.algos.train.ppo import PPOLearner
from tests.algos.train import runs
from tests.algos.train.runs import before_updates, check_states, progress_of, record_of, run, states_of

PPO = with_settings(runs.RECURRENT, collector="ray", workers=None)


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'rover_rl[ray]'")
    from ray.cluster_utils import Cluster

    # Ray gives its workers a low priority; beside other tests they would hardly start.
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112, as Ray spells it
    nodes = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False})
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
def test_a_run_on_a_cluster_ends_with_a_checkpoint_if_a_worker_is_killed(
    cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The workers carry the memory and have a curriculum of their own."""
    folder, config, collected = tmp_path / "dying", with_settings(PPO, name="dying"), list[TensorDictBase]()

    def kill(number: int, learner: PPOLearner, batch: TensorDictBase) -> None:
        if number <= 3:
            collected.append(states_of(batch))
        if number == 3:
            remote_workers()[0].send_signal(signal.SIGKILL)

    before_updates(monkeypatch, "ppo", kill)
    with pytest.raises(WorkerError, match="actor died"):
        run(config, tmp_path, total_steps=UNLIMITED_STEPS)
    checkpoint = Checkpoint.load(folder)
    assert checkpoint.steps >= 3 * 128
    check_states(collected)
    assert (checkpoint.env.backend, checkpoint.env.num_envs) == ("warp", PPO.num_envs)
    # One worker per processor of the cluster.
    assert "workers: 2" in (folder / "config.yaml").read_text()
    assert not remote_workers()
    assert progress_of(folder)["steps"] == list(range(128, checkpoint.steps + 1, 128))
    assert sum(int(row["draws"]) for row in record_of(folder)) >= 8


def test_without_ray_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r'pip install "rover_rl\[ray\]"'):
        run(PPO, tmp_path)
    assert not list(tmp_path.iterdir())
