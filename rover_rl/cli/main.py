"""The entry point: reads the command line, runs the command, and says what went wrong."""

from __future__ import annotations

import os
import re
import sys

from rover_rl.cli.demo import Demo
from rover_rl.cli.drive import Drive
from rover_rl.cli.evaluate import Evaluate
from rover_rl.cli.export import Export
from rover_rl.cli.film import Film
from rover_rl.cli.options import read_command
from rover_rl.cli.robot import RobotCommand
from rover_rl.cli.train import INTERRUPTED, train_defaults
from rover_rl.cli.worlds import Worlds
from rover_rl.files import STANDARD_OUTPUT, errors_name

FAILED = 2
"""Exit code for an error of the user's."""
CUT_OFF = 141
"""Exit code where nobody reads on what is printed, as a shell has it for SIGPIPE."""

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
    args = sys.argv[1:] if args is None else args
    # The user's worlds, robots, rewards and backends may be modules of the current folder, as with "python -m".
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        try:
            return read_command({"train": train_defaults(args), **COMMANDS}, args)()
        finally:
            _flush()
    except BrokenPipeError:
        return CUT_OFF
    except (ValueError, OSError, ImportError, FloatingPointError) as error:
        print(f"rover-rl: {_told(error)}", file=sys.stderr)
        return FAILED
    except (MemoryError, RuntimeError) as error:
        if not (isinstance(error, MemoryError) or re.search(r"allocate memory|out of memory", str(error))):
            raise
        print("rover-rl: there is not enough memory for that; smaller numbers need less", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("rover-rl: interrupted", file=sys.stderr)
        return INTERRUPTED


def _flush() -> None:
    """Writes out what was printed; what cannot be is dropped, or Python would complain of it at its end."""
    try:
        with errors_name(STANDARD_OUTPUT):
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def _told(error: Exception) -> str:
    """The error's own words; of the system's errors the file and the reason."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)


if __name__ == "__main__":
    sys.exit(main())
