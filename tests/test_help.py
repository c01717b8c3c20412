"""What ``rover-rl COMMAND --help`` prints, for every command."""

from __future__ import annotations

import itertools
import re

import pytest

from rover_rl.cli import main
from rover_rl.cli.main import COMMANDS

WIDTH = 100
SUBCOMMANDS = ["worlds import", "worlds show", "robots show", "benchmark barn", "benchmark jaxnav"]


@pytest.mark.parametrize("command", ["train", "train --algo sac", *COMMANDS, *SUBCOMMANDS])
def test_help_has_no_marks_of_the_program_and_no_sentence_is_cut(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))
    with pytest.raises(SystemExit):
        main([*command.split(), "--help"])
    text = capsys.readouterr().out
    assert not re.findall(r".*(?:\{None|None\}|default: None|default: \)|NoneType|``|:class:|:data:).*", text)
    description = re.split(r"\n.*[─-]{10}", text)[0].partition("\n\n")[2]
    # It is not wrapped by the program: a new line is a new paragraph.
    assert not re.findall(r"[^\n]+\n[^\n]+", description)
    # In a box, a line ends where the next word does not fit.
    lines = [line.strip("│|\n").rstrip() for line in text.splitlines()]
    for line, after in itertools.pairwise(lines):
        start, start_after = (len(one) - len(one.lstrip()) for one in (line, after))
        if start == start_after > 10 and "---" not in line + after:
            assert len(line) + 1 + len(after.split()[0]) > WIDTH - 4, f"{line} / {after}"
