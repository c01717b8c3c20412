"""Import and configuration of NVIDIA Warp; raises a clear error if it is not installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rover_rl.sims.native.output import native_output_silenced

if TYPE_CHECKING:
    import torch

try:
    import warp as wp
except ImportError as error:
    raise ImportError("pictures and backend='warp' need NVIDIA Warp: pip install warp-lang") from error

wp.config.log_level = wp.LOG_ERROR
# No kernel is differentiated, and adjoint kernels take a minute to compile.
wp.config.enable_backward = False
# Warp prints a warning on machines without a GPU.
with native_output_silenced():
    wp.init()

__all__ = ["stream_of", "wp"]


def stream_of(device: torch.device) -> Any:
    """Returns Torch's current stream, which orders kernels and tensor operations; ``None`` on the CPU."""
    return wp.stream_from_torch(device) if device.type == "cuda" else None
