"""Worlds as Warp kernels read them, and rays through them."""
