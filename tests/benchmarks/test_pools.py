"""The benchmark of many worlds in a batch."""

from __future__ import annotations

import pytest

from benchmarks.pools import Options, main


def test_it_measures_preparation_and_speed(capsys: pytest.CaptureFixture[str]) -> None:
    sizes = {"num_envs": 4, "worlds": 2, "length": 40, "settle": 2, "steps": 2, "rounds": 1, "prepared": 1}
    main(Options(**sizes, generators=("maze",), robots="any:0-3"))
    text = capsys.readouterr().out
    for expected in (
        "free space",
        "Memory with 2 mazes",
        "mean of one",
        "one maze, 0",
        "2 mazes",
        "another maze for each episode",
        "4 robots, another one for each episode",
        "1.00",
    ):
        assert expected in text
