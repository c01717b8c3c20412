"""Parsing with tyro, and what its help says about the options of a command."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from typing import Annotated, Any, Union

import tyro

PROGRAM = "rover-rl"
"""Name of the program."""
DESCRIPTION = "Train, evaluate and drive rovers that navigate to goals."
"""What the program does."""
_WIDTH = 110
"""Width in which tyro prints its help to be read here: a wider one has two columns of options."""


@dataclass(frozen=True)
class Option:
    """An option or argument of a command, or one of its subcommands.

    Attributes:
        head: how it is given, such as ``"--num-envs INT"`` or ``"--stamped, --no-stamped"``.
        text: what it does, with its default.
    """

    head: str
    text: str

    @property
    def names(self) -> tuple[str, ...]:
        """Names of an option, such as ``("--count", "--episodes")``. Empty for an argument."""
        return tuple(re.findall(r"--[a-z](?:[\w.-]*\w)?", self.head))

    @property
    def takes(self) -> str:
        """The values of an option, such as ``"FLOAT FLOAT"``. Empty for a flag."""
        return re.sub(r",? ?--[a-z](?:[\w.-]*\w)?", "", self.head.split(", ")[0]).strip()


@dataclass(frozen=True)
class CommandHelp:
    """What tyro's help says about a command.

    Attributes:
        name: name of the command, such as ``"worlds import"``; empty for the program.
        description: paragraphs.
        boxes: options by the title of tyro's box, such as ``"options"``, ``"subcommands"`` or ``"lidar options"``.
        notes: what each box says about its options, by title.
    """

    name: str
    description: list[str]
    boxes: dict[str, list[Option]]
    notes: dict[str, str]

    @property
    def options(self) -> list[Option]:
        """All options and arguments, without subcommands."""
        return [option for title, options in self.boxes.items() if title != SUBCOMMANDS for option in options]


ARGUMENTS, OPTIONS, SUBCOMMANDS = "positional arguments", "options", "subcommands"
"""Titles of tyro's boxes. Those of nested settings are named after them, such as ``"lidar options"``."""


def parse(commands: dict[str, Any], args: Sequence[str]) -> tuple[Any, list[str]]:
    """Parses a command line. Returns the command and the arguments that it does not take.

    Args:
        commands: dataclasses of the commands by name, or instances that hold defaults.
        args: arguments of the command line, starting with the name of the command.
    """
    kinds = [
        Annotated[kind, tyro.conf.subcommand(name)]
        if isinstance(kind, type)
        else Annotated[type(kind), tyro.conf.subcommand(name, default=kind)]
        for name, kind in commands.items()
    ]
    # A union that is built at run time cannot be type-checked.
    command: Any = Union[tuple(kinds)]  # noqa: UP007
    return tyro.cli(command, args=args, prog=PROGRAM, description=DESCRIPTION, return_unknown_args=True)


def read_help(commands: dict[str, Any], name: str) -> CommandHelp:
    """Reads tyro's help of a command.

    Args:
        commands: dataclasses of the commands by name, or instances that hold defaults.
        name: name of the command, of a subcommand such as ``"worlds import"``, or empty for the program.
    """
    head, *rest = re.split(r"\n (?=\S[^\n]*\n -{20,}\n)", _printed(commands, name))
    _, *description = [_plain(part) for part in head.split("\n\n") if part.strip()]
    boxes: dict[str, list[Option]] = {}
    notes: dict[str, str] = {}
    for box in rest:
        title, _, body = box.partition("\n")
        note, *entries = _entries(body)
        boxes[title.strip()] = [Option(_plain_head(head), _plain(text)) for head, text in entries if head[:2] != "-h"]
        notes[title.strip()] = _plain(note[1])
    return CommandHelp(name, description, boxes, notes)


def _printed(commands: dict[str, Any], name: str) -> str:
    """Returns what tyro prints as the help of a command, without box-drawing characters and colors."""
    output, columns = io.StringIO(), os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(_WIDTH)
    try:
        with redirect_stdout(output), suppress(SystemExit):
            parse(commands, [*name.split(), "--help"])
    finally:
        del os.environ["COLUMNS"]
        if columns is not None:
            os.environ["COLUMNS"] = columns
    text = re.sub(r"\x1b\[[0-9;]*m", "", output.getvalue())
    return "\n".join(line.rstrip() for line in text.splitlines()) + "\n"


def _entries(body: str) -> Iterator[tuple[str, str]]:
    """Yields the note of a box, which has no head, and the head and text of each option in it."""
    head, text = "", ""
    for line in body.splitlines():
        starts = re.match(r"  (?:  • )?(-\S.*?|[A-Z|{}\[\]][A-Z|{}\[\] .]*|(?<=• )\S+)(?:\s{2,}(\S.*))?$", line)
        if starts and not re.match(r" *-{20,}$", line):
            yield head, text
            head, text = starts[1], starts[2] or ""
        else:
            text += f"\n{'' if re.match(r' *-{20,}$', line) else line.strip()}"
    yield head, text


def _plain(text: str) -> str:
    """Returns the first paragraph of a text in one line, without backticks, and with its default as one gives it."""
    text = " ".join(text.strip().split("\n\n")[0].split()).replace("`", "")
    text = re.sub(r" ?\(default: (?:None)?\)$", "", text)
    text = re.sub(r"(?<=\(default: )(True|False)(?=\)$)", lambda flag: {"True": "yes", "False": "no"}[flag[1]], text)
    numbers = re.compile(r"(?<=\(default: )-?[\d.]+(?: -?[\d.]+)*(?=\)$)")
    return numbers.sub(lambda found: " ".join(f"{float(n):g}" if "." in n else n for n in found[0].split()), text)


def _plain_head(head: str) -> str:
    """Returns the head of an option without tyro's notation for values that may be left out or repeated."""
    head = head.strip().replace("{None}|", "").replace("STR|{[STR [STR ...]]}", "STR ...")
    head = re.sub(r"\[+(\w+(?: \w+)*) \[\1 \.\.\.\]\]+", r"\1 ...", head)
    return re.sub(r"\{(\w+(?: \w+)+)\}", r"\1", head)
