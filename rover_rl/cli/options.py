"""Command-line parsing with tyro, with each error reported in one sentence."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from difflib import get_close_matches
from typing import Annotated, Any, Union

import tyro

_PROGRAM = "rover-rl"
_DESCRIPTION = "Train, evaluate and drive rovers that navigate to goals."


def read_command(commands: dict[str, Any], args: Sequence[str]) -> Any:
    """Parses a command and its options; ``--help`` prints the help and exits.

    Args:
        commands: dataclasses of the commands by name, or instances that hold defaults.
        args: arguments of the command line, starting with the name of the command.

    Raises:
        ValueError: for an unknown command or option, or an invalid value. The message is one sentence.
    """
    name = args[0] if args else ""
    if name not in commands and name not in ("-h", "--help") and not name.startswith("--tyro-"):
        raise ValueError(f"{_unknown_command(name)} use one of {[*commands]}{_hint()}")
    errors = io.StringIO()
    try:
        with redirect_stderr(errors):
            command, unknown = _parse(commands, args)
    except SystemExit as stop:
        if not stop.code:
            raise
        name, help_text = _subcommand(commands, args)
        raise ValueError(_error_sentence(_plain(errors.getvalue()), help_text, args[1:]) + _hint(name)) from None
    if unknown:
        name, help_text = _subcommand(commands, args)
        raise ValueError(_unknown_option(unknown, help_text) + _hint(name))
    return command


def _parse(commands: dict[str, Any], args: Sequence[str]) -> tuple[Any, list[str]]:
    kinds = [
        Annotated[kind, tyro.conf.subcommand(name)]
        if isinstance(kind, type)
        else Annotated[type(kind), tyro.conf.subcommand(name, default=kind)]
        for name, kind in commands.items()
    ]
    # A union that is built at run time cannot be type-checked.
    command: Any = Union[tuple(kinds)]  # noqa: UP007
    return tyro.cli(command, args=args, prog=_PROGRAM, description=_DESCRIPTION, return_unknown_args=True)


def _subcommand(commands: dict[str, Any], args: Sequence[str]) -> tuple[str, str]:
    """Returns the name and the help of the command on the command line, or of its subcommand, as ``benchmark barn``."""
    help_text = _help(commands, args[0])
    choices = re.match(r"usage: .*\{([a-z,-]+)\}", help_text)
    if choices and len(args) > 1 and args[1] in choices[1].split(","):
        name = f"{args[0]} {args[1]}"
        return name, _help(commands, name)
    return args[0], help_text


def _help(commands: dict[str, Any], name: str) -> str:
    text = io.StringIO()
    try:
        with redirect_stdout(text):
            _parse(commands, [*name.split(), "--help"])
    except SystemExit:
        pass
    return _plain(text.getvalue())


def _plain(text: str) -> str:
    """Removes colors and the sides of boxes from a text."""
    return re.sub(r"\x1b\[[0-9;]*m|^[│|╭+╰] ?| ?[│|╮+╯]$", "", text, flags=re.MULTILINE)


def _hint(name: str = "") -> str:
    return f"; see {' '.join(filter(None, (_PROGRAM, name, '--help')))}"


def _unknown_command(name: str) -> str:
    if not name:
        return "a command is missing;"
    if name.startswith("-"):
        return f"options come after a command, and {name} stands before any;"
    return f"unknown command {name!r};"


def _unknown_option(unknown: Sequence[str], help_text: str) -> str:
    """Returns the message for arguments that a command does not take, with the most similar option."""
    options = [argument.split("=")[0] for argument in unknown if argument.startswith("-")]
    if not options:
        return f"unexpected argument {unknown[0]!r}"
    similar = get_close_matches(options[0], re.findall(r"--[a-z](?:[a-z.-]*[a-z])?", help_text), n=1)
    return f"unknown option {options[0]}" + (f", perhaps {similar[0]}" if similar else "")


def _error_sentence(tyro_error: str, help_text: str, args: Sequence[str]) -> str:
    """Condenses an error of tyro into a sentence.

    The sentence names the option, the expected and the given value. If tyro names no such option, it is the first
    paragraph of tyro's error.
    """
    _, *paragraphs = re.split(r"[─-]{3,}", tyro_error)
    paragraph = " ".join((paragraphs[0] if paragraphs else tyro_error).split())
    given = _values(args)
    for option in re.findall(r"--[\w.-]*\w", paragraph):
        # An option with another name: "--episodes INT, --count INT".
        takes = rf"^ {{0,4}}(?:--\S+ \S+, )?{re.escape(option)} ([\[{{A-Z].*?)(?:, --|\s{{2,}}|$)"
        expected = re.search(takes, help_text, re.MULTILINE)
        if option in given and expected:
            return f"{option} takes {expected[1]}, got {' '.join(given[option]) or 'nothing'}"
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
