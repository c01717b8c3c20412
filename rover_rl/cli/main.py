"""The entry point: reads the command line, runs the command, and says what went wrong."""

from __future__ import annotations

import sys
from typing import Annotated, Any, Union

import tyro

from rover_rl.cli.demo import Demo
from rover_rl.cli.drive import Drive
from rover_rl.cli.evaluate import Evaluate
from rover_rl.cli.export import Export
from rover_rl.cli.film import Film
from rover_rl.cli.robot import RobotCommand
from rover_rl.cli.train import INTERRUPTED, train_defaults
from rover_rl.cli.worlds import Worlds

FAILED = 2
"""Exit code for an error of the user's."""

COMMANDS = {
    "evaluate": Evaluate,
    "film": Film,
    "worlds": Worlds,
    "demo": Demo,
    "robot": RobotCommand,
    "drive": Drive,
    "export": Export,
}
"""The commands whose options are always the same; those of ``train`` depend on the algorithm."""


def main(args: list[str] | None = None) -> int:
    """Runs a command; returns the exit code.

    Args:
        args: of the command line; ``None`` takes the process's own.
    """
    try:
        train = train_defaults(sys.argv[1:] if args is None else args)
        kinds: list[Any] = [Annotated[type(train), tyro.conf.subcommand("train", default=train)]]
        kinds += [Annotated[kind, tyro.conf.subcommand(name)] for name, kind in COMMANDS.items()]
        # The kinds are known at run time only, where no type checker can follow.
        command: Any = Union[tuple(kinds)]  # noqa: UP007
        return tyro.cli(command, args=args, prog="rover-rl", description="Rovers that learn to drive to a goal.")()
    except (ValueError, OSError, ImportError) as error:
        print(f"rover-rl: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("rover-rl: interrupted", file=sys.stderr)
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
