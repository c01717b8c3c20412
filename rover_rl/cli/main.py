"""The entry point: reads the command line, runs the command, and says what went wrong."""

from __future__ import annotations

import sys
from typing import Annotated

import tyro

from rover_rl.cli.demo import Demo
from rover_rl.cli.evaluate import Evaluate
from rover_rl.cli.train import INTERRUPTED, Train
from rover_rl.cli.worlds import Worlds

FAILED = 2
"""Exit code for an error of the user's."""

Command = (
    Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Worlds, tyro.conf.subcommand("worlds")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def main(args: list[str] | None = None) -> int:
    """Runs a command; returns the exit code.

    Args:
        args: of the command line; ``None`` takes the process's own.
    """
    try:
        command = tyro.cli(Command, args=args, prog="rover-rl", description="Rovers that learn to drive to a goal.")
        return command()
    except (ValueError, OSError) as error:
        print(f"rover-rl: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("rover-rl: interrupted", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
