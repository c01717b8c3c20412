"""Gazebo's command, if it is installed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rover_rl.sims.ros2 import PoseResetError
from rover_rl.sims.ros2.pose_reset import TargetPose, place_in_gazebo

pytestmark = [pytest.mark.ros2, pytest.mark.slow]

SERVICE = Path("/usr/libexec/ignition/transport11/ign-transport-service")
needs_gazebo = pytest.mark.skipif(
    not SERVICE.is_file(), reason="Gazebo's command is not installed (Debian: ignition-transport-cli)"
)


@needs_gazebo
def test_gazebos_command_fails_without_gazebo(tmp_path, monkeypatch):
    # Debian's own wrapper, ``ign``, looks for the command in the wrong folder.
    wrapper = tmp_path / "ign"
    wrapper.write_text(f'#!/bin/sh\nshift\nexec {SERVICE} "$@"\n')
    wrapper.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("IGN_PARTITION", str(tmp_path))
    with pytest.raises(PoseResetError, match="Service call timed out"):
        place_in_gazebo("ign", "maze", "rover_zero4wd", TargetPose(1.0, 2.0, 0.5, 0.0))
