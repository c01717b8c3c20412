"""Command-line parsing, with each error reported in one sentence."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from contextlib import redirect_stderr
from difflib import get_close_matches
from importlib.metadata import version
from typing import Any

from rich.console import Console

from rover_rl.cli.help import print_help
from rover_rl.cli.parsing import PROGRAM, SUBCOMMANDS, Option, parse, read_help
from rover_rl.registry import perhaps

_HELP = {"-h", "--help"}
"""Options that print the help."""


def read_command(commands: dict[str, Any], args: Sequence[str]) -> Any:
    """Parses a command and its options; ``--help`` and ``--version`` print and exit.

    Args:
        commands: dataclasses of the commands by name, or instances that hold defaults.
        args: arguments of the command line, starting with the name of the command.

    Raises:
        ValueError: for an unknown command or option, or an invalid value. The message is one sentence.
    """
    name = args[0] if args else ""
    if name == "--version":
        print(f"{PROGRAM} {version(PROGRAM)}")
        raise SystemExit(0)
    if name not in commands and name not in _HELP and not name.startswith("--tyro-"):
        raise ValueError(f"{_unknown_command(name, commands)} use one of {[*commands]}{_hint()}")
    if not _HELP.isdisjoint(args):
        console = Console()
        # Rich would exit when a pipe is closed.
        with console.capture() as text:
            print_help(commands, _command(commands, args), console)
        print(text.get(), end="")
        raise SystemExit(0)
    errors = io.StringIO()
    try:
        with redirect_stderr(errors):
            command, unknown = parse(commands, args)
    except SystemExit as stop:
        if not stop.code:
            raise
        name = _command(commands, args)
        options = _known_options(commands, name, args)
        error = re.sub(r"\x1b\[[0-9;]*m|^[│|╭+╰] ?| ?[│|╮+╯]$", "", errors.getvalue(), flags=re.MULTILINE)
        raise ValueError(_error_sentence(error, options, args[1:]) + _hint(name)) from None
    if unknown:
        name = _command(commands, args)
        raise ValueError(_unknown_option(unknown, _known_options(commands, name, args)) + _hint(name))
    return command


def _command(commands: dict[str, Any], args: Sequence[str]) -> str:
    """Returns the name of the command on the command line, or of its subcommand, as ``benchmark barn``."""
    name = args[0]
    if name in _HELP:
        return ""
    subcommands = [option.head for option in read_help(commands, name).boxes.get(SUBCOMMANDS, ())]
    return " ".join([name, *[word for word in args[1:] if word in subcommands][:1]])


def _known_options(commands: dict[str, Any], name: str, args: Sequence[str]) -> list[Option]:
    """Returns the options of the command ``name``.

    Raises:
        ValueError: if its subcommand is unknown or missing.
    """
    found = read_help(commands, name)
    subcommands = [option.head for option in found.boxes.get(SUBCOMMANDS, ())]
    given = next((word for word in args[1:2] if not word.startswith("-")), "")
    if subcommands and given:
        similar = perhaps(given, subcommands)
        raise ValueError(f"unknown command '{name} {given}'{similar}; use one of {subcommands}{_hint(name)}")
    if subcommands and not found.options:
        raise ValueError(f"{name} needs a command; use one of {subcommands}{_hint(name)}")
    return found.options


def _hint(name: str = "") -> str:
    return f"; see {' '.join(filter(None, (PROGRAM, name, '--help')))}"


def _unknown_command(name: str, commands: Iterable[str]) -> str:
    if not name:
        return "a command is missing;"
    if name.startswith("-"):
        return f"options come after a command, and {name} stands before any;"
    return f"unknown command {name!r}{perhaps(name, commands)};"


def _unknown_option(unknown: Sequence[str], known: Sequence[Option]) -> str:
    """Returns the message for arguments that a command does not take, with the most similar option."""
    options = [argument.split("=")[0] for argument in unknown if argument.startswith("-")]
    if not options:
        return f"unexpected argument {unknown[0]!r}"
    similar = get_close_matches(options[0], [name for option in known for name in option.names], n=1)
    return f"unknown option {options[0]}" + (f", perhaps {similar[0]}" if similar else "")


def _error_sentence(tyro_error: str, known: Sequence[Option], args: Sequence[str]) -> str:
    """Condenses an error of tyro into a sentence.

    The sentence names the option, the expected and the given value. If tyro names no such option, it is the first
    paragraph of tyro's error.
    """
    _, *paragraphs = re.split(r"[─-]{3,}", tyro_error)
    paragraph = " ".join((paragraphs[0] if paragraphs else tyro_error).split())
    given = _values(args)
    takes = {name: option.takes for option in known for name in option.names}
    for option in re.findall(r"--[\w.-]*\w", paragraph):
        if option in given and takes.get(option):
            return f"{option} takes {takes[option]}, got {' '.join(given[option]) or 'nothing'}"
    # An error of a dataclass: "Error parsing __tyro-dummy-inner__.env.task: ..." becomes "task: ...".
    paragraph = re.sub(r"^Error parsing \S*?([\w-]+): ", r"\1: ", paragraph).removeprefix("__tyro-dummy-inner__: ")
    missing = r"^Missing from \S+ ([\w -]+): (?:(--[\w-]+) )?\S+ (.*?)( \(required\))?$"
    paragraph = re.sub(missing, lambda part: f"{part[1]} needs{f' {part[2]}' if part[2] else ''}: {part[3]}", paragraph)
    return paragraph.rstrip(".")


def _values(args: Sequence[str]) -> dict[str, list[str]]:
    """Returns the values of each option on the command line; those of no option have the key ``""``."""
    given: dict[str, list[str]] = {}
    option = ""
    for argument in args:
        if argument.startswith("--"):
            option, equals, value = argument.partition("=")
            option = option.replace("_", "-")
            given[option] = [value] if equals else []
        else:
            given.setdefault(option, []).append(argument)
    return given
