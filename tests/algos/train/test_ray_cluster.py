"""Training on a Ray cluster of two nodes on this machine, with one processor each."""

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
def test_ppo_takes_the_same_steps_as_on_one_machine_also_if_workers_were_killed(
    cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The workers carry the memory and have a curriculum of their own."""
    folder, config, collected = tmp_path / "dying", with_settings(PPO, name="dying"), list[TensorDictBase]()

    def kill(number: int, learner: PPOLearner, batch: TensorDictBase) -> None:
        if number <= 3:
            collected.append(states_of(batch, "gru"))
        if number == 3:
            remote_workers()[0].send_signal(signal.SIGKILL)

    before_updates(monkeypatch, "ppo", kill)
    with pytest.raises(WorkerError, match="actor died"):
        run(config, tmp_path, total_steps=UNLIMITED_STEPS)
    monkeypatch.undo()
    checkpoint = Checkpoint.load(folder)
    steps = checkpoint.steps
    assert steps >= 3 * 128
    check_states(collected, "gru")
    assert (checkpoint.env.backend, checkpoint.env.num_envs) == ("warp", PPO.num_envs)
    # One worker per processor of the cluster.
    assert "workers: 2" in (folder / "config.yaml").read_text()
    assert not remote_workers()
    # Without the cluster, whose workers take seconds to start.
    again = run(config, tmp_path, folder, collector="auto", workers=1, total_steps=steps + 128)
    assert again.steps == steps + 128
    assert progress_of(folder)["steps"] == list(range(128, steps + 129, 128))
    assert sum(again.shares.values()) == pytest.approx(1)
    assert sum(int(row["draws"]) for row in record_of(folder)) >= 16


def test_without_ray_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r'pip install "rover_rl\[ray\]"'):
        run(PPO, tmp_path)
    assert not list(tmp_path.iterdir())
