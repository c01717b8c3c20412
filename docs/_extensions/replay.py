"""Directive ``replay``: a replay of a drive in the page, which ``rover-rl`` writes at build time.

Its content is a command such as ``film pretrained:anywhere --world moon``, to which the build adds ``--html FILE``. A
build that does not run the examples, with ``plot_gallery=0``, does not run it either and has no replay.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from rover_rl.cli.main import main

STYLE = "width:100%;height:480px;border:0;border-radius:6px"


class Replay(SphinxDirective):
    """Shows the replay that a command writes."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Writes the replay and returns the frame that shows it."""
        if self.config.plot_gallery in (False, "0", "False", 0):
            return []
        command = " ".join(self.content)
        name = f"replay-{hashlib.sha256(command.encode()).hexdigest()[:8]}.html"
        path = Path(self.env.app.outdir, "_static", name)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() and main([*command.split(), "--html", str(path)]):
            raise self.error(f"rover-rl {command} failed")
        frame = f'<iframe src="_static/{name}" title="A replay" loading="lazy" style="{STYLE}"></iframe>'
        return [nodes.raw("", frame, format="html")]


def setup(app: Sphinx) -> dict[str, Any]:
    """Adds the directive to a build."""
    app.add_directive("replay", Replay)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
