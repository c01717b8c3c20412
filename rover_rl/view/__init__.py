"""A viewer in the browser: watch rovers, take the wheel, look inside. It needs the extra ``view``."""

from __future__ import annotations

try:
    import viser as _  # noqa: F401
except ImportError as error:
    raise ImportError('the viewer needs viser, an extra: pip install "rover_rl[view]"') from error

from rover_rl.view.viewer import Viewer

__all__ = ["Viewer"]
