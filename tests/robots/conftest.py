"""Fixture for modified versions of Rover Zero's URDF."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rover_rl.robots import get_robot

Edit = Callable[..., Path]


@pytest.fixture
def edited(tmp_path: Path) -> Edit:
    """Writes Rover Zero's URDF with replaced text: the first ``count`` occurrences, or all with -1."""

    def write(*replacements: tuple[str, str], count: int = 1) -> Path:
        text = get_robot("rover_zero").urdf.read_text()
        for old, new in replacements:
            assert old in text
            text = text.replace(old, new, count)
        path = tmp_path / "rover.urdf"
        path.write_text(text)
        return path

    return write
