"""Import and configuration of NVIDIA Warp."""

from __future__ import annotations

import warp as wp

from rover_rl.sims.native.output import native_output_silenced

wp.config.log_level = wp.LOG_ERROR
# The simulator is not differentiated, and adjoint kernels take a minute to compile.
wp.config.enable_backward = False
# Warp prints a warning on machines without a GPU.
with native_output_silenced():
    wp.init()

__all__ = ["wp"]
