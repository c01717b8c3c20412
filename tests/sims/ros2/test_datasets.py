"""Data sets of recorded drives: Minari reads back what the environment saw, did and paid."""

from __future__ import annotations

import numpy as np
import pytest

from rover_rl import Terrain, World, box
from rover_rl.algos.deploy.bags import DriveBag
from rover_rl.algos.deploy.driving import drive_to
from rover_rl.algos.driving import TIME_LIMIT
from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.cli.main import main
from tests.extras import needs_minari

COURSE = World("course", Terrain.flat((20, 20)), obstacles=[box((3.2, 0, 0.5), (0.4, 8, 1))])


@pytest.fixture
def bag(start_env, tmp_path, monkeypatch):
    """A bag of two drives, the first of which ends at its goal, and what the environment saw in them."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    _, env = start_env(COURSE, (0.0, 0.0, 0.0))
    path, seen = tmp_path / "drive.mcap", []

    def policy(now):
        seen.append({name: now[name][0].clone() for name in ("lidar", "pose", "imu", "target", "velocities")})
        return ScriptedPolicy()(now)

    with DriveBag(path, "none", "scripted", 60.0) as written:
        env.simulator.tap(written.add)
        assert drive_to(env, policy, (1.2, 0.3), bag=written) == "goal"
        assert drive_to(env, policy, (-3.0, 0.0), seconds=1.0, bag=written) == TIME_LIMIT
    return path, seen


@needs_minari
def test_minari_reads_what_the_environment_saw_did_and_paid(bag, tmp_path, capsys):
    import minari

    path, seen = bag
    assert main(["dataset", str(path), "--out", str(tmp_path / "drives-v0")]) == 0
    data = minari.MinariDataset(tmp_path / "drives-v0" / "data")
    assert minari.load_dataset("drives-v0").total_steps == data.total_steps
    reached, stopped = list(data.iterate_episodes())
    assert f"2 episodes, {len(reached) + len(stopped)} steps" in capsys.readouterr().out
    assert (reached.terminations.sum(), reached.truncations.sum(), reached.terminations[-1]) == (1, 0, True)
    assert (stopped.terminations.sum(), stopped.truncations.sum(), stopped.truncations[-1]) == (0, 1, True)
    assert len(stopped) == 20
    assert reached.rewards[-1] == pytest.approx(100.0)  # the goal's, of the contract
    assert data.action_space.contains(reached.actions[0].astype(np.float32))
    assert all(data.observation_space.contains({k: v[3] for k, v in each.observations.items()}) for each in data)
    assert np.abs(reached.actions[:, 0]).max() > 0.3
    # The policy also decided once at the warm-up of each drive.
    before = seen[1 : len(reached) + 1]
    for name in ("lidar", "pose", "imu", "target", "velocities"):
        expected = np.stack([each[name].numpy() for each in before])
        np.testing.assert_allclose(reached.observations[name][:-1], expected, atol=1e-3, err_msg=name)
