"""Entry point: parses the command line, runs the command and prints errors."""

from __future__ import annotations

import os
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import tyro

from rover_rl.cli.benchmark import Benchmark
from rover_rl.cli.calibrate import Calibrate
from rover_rl.cli.compare import Compare
from rover_rl.cli.dataset import Dataset
from rover_rl.cli.demo import Demo
from rover_rl.cli.drive import Drive
from rover_rl.cli.evaluate import Evaluate
from rover_rl.cli.export import Export
from rover_rl.cli.film import Film
from rover_rl.cli.help_text import ReadableHelp
from rover_rl.cli.play import Play
from rover_rl.cli.robot import Robot
from rover_rl.cli.robots import Robots
from rover_rl.cli.ros_arguments import split_ros_arguments
from rover_rl.cli.tasks import Tasks
from rover_rl.cli.train import FAILED, INTERRUPTED, train_defaults
from rover_rl.cli.view import View
from rover_rl.cli.worlds import Worlds
from rover_rl.files import STANDARD_OUTPUT, errors_name
from rover_rl.option_names import options_of_command
from rover_rl.registry import perhaps

PROGRAM = "rover-rl"  # name of the program
BROKEN_PIPE = 141  # exit code when the reader of the output has closed the pipe: 128 + SIGPIPE, as in a shell

_OUT_OF_MEMORY = re.compile("allocate memory|out of memory|Failed to allocate")
"""What PyTorch's and Warp's errors say if there is not enough memory."""

_KINDS = (Evaluate, Compare, Benchmark, Play, View, Film, Tasks, Worlds, Robots, Demo, Robot, Drive)
COMMANDS = {kind.__name__.lower(): kind for kind in (*_KINDS, Calibrate, Dataset, Export)}
"""Commands by name, without train, whose options depend on the algorithm."""


def commands(args: Sequence[str] = ()) -> dict[str, Any]:
    """Returns all commands by name: dataclasses, or an instance that holds defaults, which depend on ``args``."""
    return {"train": train_defaults(args), **COMMANDS}


def read_command(args: Sequence[str]) -> Any:
    """Parses a command and its options. Wrong options, ``--help`` and ``--version`` exit."""
    known = commands(args)
    name = args[0] if args else ""
    if name == "--version":
        print(f"{PROGRAM} {version(PROGRAM)}")
        raise SystemExit(0)
    if name in ("-h", "--help"):
        lines = [f"  {name:10} {command.__doc__.splitlines()[0]}" for name, command in known.items()]
        print(f"Usage: {PROGRAM} COMMAND [OPTIONS]", "", *lines, "", f"See {PROGRAM} COMMAND --help.", sep="\n")
        raise SystemExit(0)
    if name not in known:
        wrong = f"unknown command {name!r}{perhaps(name, known)}" if name else "a command is missing"
        raise ValueError(f"{wrong}; use one of {[*known]}; see {PROGRAM} --help")
    command, rest = known[name], args[1:]
    if getattr(command, "first_word", None) is not None:
        # The task has given the defaults of the options.
        rest = rest[1:]
    default = {} if isinstance(command, type) else {"default": command}
    kind = command if isinstance(command, type) else type(command)
    rest, rules = split_ros_arguments(rest) if name in ("drive", "robot") else (rest, None)
    with ReadableHelp(getattr(kind, "shown", None)):
        read = tyro.cli(kind, args=rest, prog=f"{PROGRAM} {name}", **default)
    return replace(read, ros_args=rules) if rules else read


def main(args: list[str] | None = None) -> int:
    """Runs a command and returns its exit code."""
    args = sys.argv[1:] if args is None else args
    # The user's worlds, robots, rewards and backends may be modules of the current folder, as with "python -m".
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        try:
            with options_of_command("rover-rl worlds import "), _warnings_as_lines():
                return int(read_command(args)())
        finally:
            _flush()
    except BrokenPipeError:
        return BROKEN_PIPE
    except (ValueError, OSError, ImportError, FloatingPointError) as error:
        print(f"rover-rl: {_error_message(error)}", file=sys.stderr)
        return FAILED
    except (MemoryError, RuntimeError) as error:
        if not (isinstance(error, MemoryError) or _OUT_OF_MEMORY.search(str(error))):
            raise
        on_gpu = "cuda" in str(error).lower()
        advice = " on the GPU; use fewer rovers (--num-envs) or smaller values" if on_gpu else "; use smaller values"
        print(f"rover-rl: not enough memory{advice}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("rover-rl: interrupted", file=sys.stderr)
        return INTERRUPTED


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    usual = warnings.formatwarning
    warnings.formatwarning = lambda message, *_, **__: f"rover-rl: {message}\n"
    try:
        yield
    finally:
        warnings.formatwarning = usual


def _flush() -> None:
    """Flushes standard output. If that fails, discards the rest, so that Python does not fail again at exit."""
    try:
        with errors_name(STANDARD_OUTPUT):
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise


def _error_message(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    return str(error)


if __name__ == "__main__":
    sys.exit(main())
