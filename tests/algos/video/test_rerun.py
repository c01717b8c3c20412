"""Drives for Rerun. Its own program reads the file."""

from __future__ import annotations

import subprocess
import sys

import pytest

from rover_rl.algos.policy.baselines import ScriptedPolicy
from rover_rl.algos.video.recording import record_endless
from rover_rl.algos.video.rerun_export import write_rrd

pytest.importorskip("rerun", reason="needs rerun-sdk")


def test_a_drive_among_movers_is_a_file_that_rerun_reads(tmp_path):
    drive = record_endless(ScriptedPolicy(), "crossing", seconds=0.5, rows=2, seed=0, env=None)
    write_rrd(drive, tmp_path / "drive.rrd")

    def rerun(command: str) -> str:
        program = [sys.executable, "-m", "rerun", "rrd", command, str(tmp_path / "drive.rrd")]
        return subprocess.run(program, capture_output=True, text=True, check=True, timeout=60).stdout

    rerun("verify")
    listed = rerun("print")
    for entity in ("ground", "rovers/0", "rovers/1", "movers/0", "goals", "lidar_hits", "driven_path"):
        assert f"/world/{entity}" in listed
    assert "/curves/" in listed
