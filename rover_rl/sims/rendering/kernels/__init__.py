"""Warp kernels of the renderer, a ray tracer."""
