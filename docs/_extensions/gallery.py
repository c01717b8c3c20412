"""The gallery: order of the examples, and links to them."""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx

ORDER = (
    "gymnasium_drive.py",
    "lidar_scan.py",
    "cameras.py",
    "own_world.py",
    "import_map.py",
    "own_robot.py",
    "own_reward.py",
    "evaluate_policies.py",
    "fine_tuning.py",
    "deploy_policy.py",
    "decision_time.py",
    "torchrl_ppo.py",
    "sb3_sac.py",
    "sweep.py",
)
"""Examples from the simplest to the longest."""


def setup(app: Sphinx) -> dict[str, Any]:
    """Connects the extension to a build."""
    app.connect("source-read", link_examples)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}


def link_examples(app: Sphinx, document: str, source: list[str]) -> None:
    """Links to the pages of the examples, where the pages in the repository link to their files."""
    source[0] = re.sub(r"\]\(\.\./examples/(\w+)\.py\)", r"](gallery/\1.rst)", source[0])
    source[0] = source[0].replace("](../examples)", "](gallery/index.rst)")


def place_of(name: str) -> int:
    """Returns the place of an example in the gallery.

    Raises:
        ValueError: if the example is not in :data:`ORDER`.
    """
    return ORDER.index(name)
