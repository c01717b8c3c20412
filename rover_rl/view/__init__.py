"""A viewer in the browser: watch rovers, take the wheel, look inside. It needs the extra ``view``."""

from __future__ import annotations

from rover_rl.view.viewer import Viewer

__all__ = ["Viewer"]
