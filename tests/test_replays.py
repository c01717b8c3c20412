"""The page of ``rover-rl evaluate --html``: which drives it shows, and its progress."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from rover_rl.algos.evaluation.results import StoredEvaluation
from rover_rl.algos.video.recording import Recording
from rover_rl.cli.replays import DRIVES, SECONDS, write_worst
from rover_rl.envs.config import EnvConfig
from rover_rl.progress import ProgressDisplay, redirected_progress

ENDINGS = ["goal", "goal", "stuck", "goal", "flipped", "goal", "goal", "goal"]


@pytest.mark.parametrize(("policies", "each"), [(1, 6), (2, 6), (4, 3), (6, 2), (30, 1)])
def test_evaluations_share_the_drives_of_a_page_failures_first_with_one_progress(
    monkeypatch: pytest.MonkeyPatch, policies: int, each: int
) -> None:
    pytest.importorskip("viser", reason="needs rover_rl[view]")
    worlds: Any = SimpleNamespace(worlds=[SimpleNamespace(name="maze")] * len(ENDINGS))
    shown: list[tuple[list[Recording], list[str]]] = []
    driven: list[int] = []

    def stored(_: Path, name: str, *places: str) -> StoredEvaluation:
        return StoredEvaluation(name, worlds, 1, 60.0, EnvConfig(), ENDINGS, [float(k) for k in range(len(ENDINGS))])

    def drive(_: Any, __: StoredEvaluation, episode: int) -> Recording:
        with ProgressDisplay("driving") as display:
            display.update(1.0)
        driven.append(episode)
        moments: Any = range(1201)
        return Recording(moments, worlds.worlds[0], None, torch.zeros(0), 0.05)  # type: ignore[arg-type]

    def write(drives: list[Recording], _: Path, titles: list[str]) -> None:
        with ProgressDisplay("drawing") as display:
            display.update(1.0)
        shown.append((drives, titles))

    monkeypatch.setattr("rover_rl.algos.evaluation.results.read_evaluation", stored)
    monkeypatch.setattr("rover_rl.algos.video.recording.record_stored", drive)
    monkeypatch.setattr("rover_rl.view.replay.write_replay", write)
    names = [f"policy {number}" for number in range(policies)]
    evaluations: Any = [
        SimpleNamespace(name=one, episodes=SimpleNamespace(name="maze"), backend="warp") for one in names
    ]
    told: list[float] = []
    with redirected_progress(told.append):
        count = write_worst(evaluations, [SimpleNamespace(name=n, module=None) for n in names], Path(), Path())  # type: ignore[misc]
    ((drives, titles),) = shown
    assert count == len(drives) == len(titles) == min(policies * each, DRIVES)
    assert sum(drive.seconds for drive in drives) <= SECONDS + 1e-6
    assert driven[:each][:2] == [2, 4][:each]
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(told) == count + 1
