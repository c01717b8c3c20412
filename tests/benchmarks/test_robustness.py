from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from benchmarks import robustness


@pytest.mark.slow
def test_success_is_measured_as_sensors_get_worse_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robustness, "SWEEPS", dict(list(robustness.SWEEPS.items())[:2]))
    for axis, (setting, values) in robustness.SWEEPS.items():
        monkeypatch.setitem(robustness.SWEEPS, axis, (setting, values[:2]))
    out, plot = tmp_path / "found.json", tmp_path / "found.png"
    robustness.main(robustness.Options(out, plot, policies=("gridplanner",), world="maze:10000-10003"))
    found = json.loads(out.read_text())
    assert list(found) == list(robustness.SWEEPS)
    for rates in found.values():
        assert len(rates["gridplanner"]) == 2
        # With exact sensors.
        assert rates["gridplanner"][0] >= 0.75
    assert Image.open(plot).width > 600


def test_worse_sensors_are_those_of_the_axes() -> None:
    late, pose = robustness.SWEEPS["delay of scans and state, ms"][0](200)
    assert (late.scan_latency, late.state_latency) == ((4, 4), (4, 4))
    assert pose.source == "truth"
    exact, pose = robustness.SWEEPS["jumps of the pose each second, cm"][0](10)
    assert (pose.source, pose.jump, exact.range_noise) == ("localized", 0.1, 0.0)
