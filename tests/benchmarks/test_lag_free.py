from __future__ import annotations

import pytest

from benchmarks.lag_free import Options, main


@pytest.mark.slow
def test_the_limits_calm_a_drive_without_lag_and_it_reaches_its_goals(tmp_path):
    """Without them nearly every command changes the turning direction, and the rover stays where it is."""
    policy = "moon-sac"
    results = main(Options(policies=(policy,), count=2, seconds=12.0, out=tmp_path))[policy]
    without, limited = results["without limits"], results["with limits"]
    assert limited["reversals a second"] <= without["reversals a second"] / 5
    assert without["reversals a second"] > 15
    assert limited["success"] == 1.0 >= without["success"]
    assert (tmp_path / "lag_free.json").is_file()
