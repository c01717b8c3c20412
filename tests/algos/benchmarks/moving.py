"""Small JSON files of worlds with movers, in the formats of the public ones."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

AWAY = {"period": 4.0, "keys": [[0.0, 0.0, 9.0, 0.0], [4.0, 2.0, 9.0, 0.0]]}
"""A motion far from the rovers' ways."""
TOWARDS = {"period": 10.0, "keys": [[0.0, 6.0, 0.0, 3.14], [5.0, 16.0, 0.0, 3.14]]}
"""A motion along the way from DynaBARN's start, towards the rover, and at rest from 5 to 10 s."""
UP = {"period": 20.0, "keys": [[0.0, -2.0, 8.0, -1.57], [10.0, -2.0, -2.0, -1.57]]}
"""A motion along the way from the start of ros_jackal, towards the rover."""


def dynabarn() -> dict[str, Any]:
    """Three worlds: an easy one with nothing in the way, an easy one with a cylinder that comes, and a medium one."""
    return {
        "cylinder_radius": 0.5,
        "motions": {"away": AWAY, "towards": TOWARDS},
        "worlds": {"0": ["away"], "3": ["away", "towards"], "21": ["away"] * 15},
    }


def ros_jackal() -> dict[str, Any]:
    """Two worlds: boxes of which one comes, and a wall of cylinders in front of the start."""
    wall = [[-3.0 + 0.15 * k, 4.0, 0.075] for k in range(14)]
    return {
        "motions": {"away": {**AWAY, "keys": [[0.0, 5.0, 9.0, 0.0], [4.0, 7.0, 9.0, 0.0]]}, "up": UP},
        "worlds": {
            "300": {"movers": [{"motion": "up", "size": [0.4, 0.6, 1.0]}], "static_cylinders": []},
            "301": {"movers": [{"motion": "away", "size": [0.1, 4.0, 1.0]}]},
            "400": {"movers": [{"motion": "away", "size": [0.1, 4.0, 1.0]}], "static_cylinders": wall},
        },
    }


def write(path: Path, content: Any) -> Path:
    """Writes a file and returns its path."""
    path.write_text(json.dumps(content))
    return path
