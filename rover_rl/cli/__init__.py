"""The command line: ``rover-rl train | evaluate | film | worlds | demo``. A module a command.

What a command needs is imported when it runs, so that ``--help`` comes at once.
"""

from rover_rl.cli.main import main

__all__ = ["main"]
