from __future__ import annotations

from pathlib import Path

import pytest

from rover_rl.cli.evaluate import split_task
from rover_rl.tasks.task import get_task


def test_the_first_word_names_a_task_unless_it_names_a_policy_or_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert split_task(("mazes", "scripted")) == (get_task("mazes"), ("scripted",))
    assert split_task(("rover_rl.tasks.field:FIELD",)) == (get_task("field"), ())
    policies = ("pretrained:anywhere", "scripted"), ("rover_rl.algos.policy.dwa:DynamicWindowPolicy", "scripted"), ()
    assert all(split_task(words) == (None, words) for words in policies)
    (tmp_path / "mazes").mkdir()
    assert split_task(("mazes",)) == (None, ("mazes",))
