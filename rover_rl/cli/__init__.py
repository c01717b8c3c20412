"""Command-line interface ``rover-rl``, with one module per command.

Commands import their dependencies when they run, so that ``--help`` is fast.
"""

from rover_rl.cli.main import main

__all__ = ["main"]
