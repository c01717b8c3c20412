from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks import results
from rover_rl.algos.config import with_settings
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.pretrained import load_pretrained


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
def test_it_trains_measures_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pretrained = load_pretrained("moon-ppo")
    config = with_settings(pretrained.config, world="maze", backend="warp", num_envs=4, rollout_length=4, hidden=(8,))
    for module in ("rover_rl.algos.workers", "rover_rl.algos.evaluation.cores"):
        monkeypatch.setattr(f"{module}.usable_cores", lambda: 1)
    monkeypatch.setattr(results, "OTHER_MAZES", ("maze:10001",))
    monkeypatch.setattr(results, "load_pretrained", lambda name: replace(pretrained, config=config))
    common = {"policies": ["moon-ppo"], "seeds": [3], "minutes": 1e-6, "runs": tmp_path}
    options = results.Options(**common, count=2, seconds=0.5, endless=1)
    assert results.main(options) == 0
    found, checkpoint = json.loads((tmp_path / "results.json").read_text()), Checkpoint.load(tmp_path / "moon-ppo-3")
    assert list(found) == ["moon-ppo-3"]
    assert checkpoint.config.seed == 3
    assert found["moon-ppo-3"]["steps"] == checkpoint.steps > 0
    assert found["moon-ppo-3"]["steps to 90%"] is None
    assert {"results.md", "learning_curves.png"} <= {file.name for file in tmp_path.iterdir()}
    # There is nothing left to train or to measure.
    before = (tmp_path / "moon-ppo-3" / "checkpoint.pt").read_bytes()
    monkeypatch.setattr(results, "_measure", None)
    assert results.main(options) == 0
    assert (tmp_path / "moon-ppo-3" / "checkpoint.pt").read_bytes() == before
