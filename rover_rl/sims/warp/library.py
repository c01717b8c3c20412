"""NVIDIA Warp, with a clear error where it is missing and without its greetings."""

from __future__ import annotations

from rover_rl.sims.native.output import native_output_silenced

try:
    import warp as wp
except ImportError as error:
    raise ImportError("backend='warp' needs NVIDIA Warp: pip install 'rover_rl[warp]'") from error

wp.config.log_level = wp.LOG_ERROR
# Nothing is differentiated, and gradients take a minute to compile.
wp.config.enable_backward = False
# That there is no GPU is nothing to warn of.
with native_output_silenced():
    wp.init()

__all__ = ["wp"]
