"""NVIDIA Warp, with a clear error where it is missing and without its greetings."""

from __future__ import annotations

try:
    import warp as wp
except ImportError as error:
    raise ImportError("backend='warp' needs NVIDIA Warp: pip install 'rover_rl[warp]'") from error

wp.config.log_level = wp.LOG_ERROR
# Nothing is differentiated, and gradients take a minute to compile.
wp.config.enable_backward = False
wp.init()

__all__ = ["wp"]
