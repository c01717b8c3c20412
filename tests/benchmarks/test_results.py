from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import results
from rover_rl.algos.config import with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.pretrained import load_pretrained


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes trainings and evaluations in endless mode short, and runs them in this process."""
    pretrained = load_pretrained("moon-ppo")
    config = with_settings(pretrained.config, world="maze", backend="warp", num_envs=4, rollout_length=4, hidden=(8,))
    for module in ("rover_rl.algos.workers", "rover_rl.algos.evaluation.cores"):
        monkeypatch.setattr(f"{module}.usable_cores", lambda: 1)
    monkeypatch.setattr(results, "OTHER_MAZES", ("maze:10001",))
    monkeypatch.setattr(results, "load_pretrained", lambda name: replace(pretrained, config=config))
    monkeypatch.setattr(results, "ENDLESS", 1.0)


def test_a_table_has_the_mean_the_least_and_the_most_of_the_seeds() -> None:
    told = results.table(
        {
            "moon-ppo-0": {"steps": 500_000, "steps to 90%": 1000, "SR": 0.9, "failed: stuck": 0.1},
            "moon-ppo-1": {"steps": 500_000, "steps to 90%": None, "SR": 1.0},
            "anywhere-0": {"steps": 1_500_000, "steps to 90%": None, "SR": 0.5, "SR in maze:10001": 0.25},
        }
    ).splitlines()
    assert told[0] == "| | moon-ppo | anywhere |"
    assert "| steps | 500,000 (500,000 to 500,000) | 1,500,000 |" in told
    assert "| steps to 90% | 1,000 (1,000 to 1,000, 1 never) | never |" in told
    assert "| SR | 0.95 (0.9 to 1) | 0.5 |" in told
    assert "| failed: stuck | 0.05 (0 to 0.1) |  |" in told
    assert "| SR in maze:10001 |  | 0.25 |" in told


@pytest.mark.slow
@pytest.mark.usefixtures("small")
def test_it_trains_measures_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = results.Options(
        policies=["moon-ppo"], seeds=[3, 4], minutes=1e-6, count=2, seconds=0.5, endless=1, runs=tmp_path
    )
    assert results.main(options) == 0
    told = json.loads((tmp_path / "results.json").read_text())
    assert list(told) == ["moon-ppo-3", "moon-ppo-4"]
    for seed in (3, 4):
        checkpoint = Checkpoint.load(tmp_path / f"moon-ppo-{seed}")
        assert checkpoint.config.seed == seed
        assert told[f"moon-ppo-{seed}"]["steps"] == checkpoint.steps > 0
        assert told[f"moon-ppo-{seed}"]["steps to 90%"] is None
    assert {"results.md", "learning_curves.png"} <= {file.name for file in tmp_path.iterdir()}
    before = (tmp_path / "moon-ppo-3" / "checkpoint.pt").read_bytes()
    # There is nothing left to measure, for a process per run.
    monkeypatch.setattr("rover_rl.algos.evaluation.cores.usable_cores", lambda: 2)
    assert results.main(options) == 0
    assert (tmp_path / "moon-ppo-3" / "checkpoint.pt").read_bytes() == before
