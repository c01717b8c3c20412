"""Names of options in messages: as in Python, or as on the command line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_command: ContextVar[str | None] = ContextVar("command", default=None)
"""What stands before an option on the command line, ``""`` for the importer's own command; ``None`` in Python."""
_FLAGS = {"spawn_range": "spawn", "goal_range": "goal"}
"""Names of options on the command line, where they differ."""


@contextmanager
def options_of_command(command: str) -> Iterator[None]:
    """Messages in the block name options as on the command line, after ``command``, which ends with a space."""
    token = _command.set(command)
    try:
        yield
    finally:
        _command.reset(token)


def written(name: str, value: str | None = None) -> str:
    """Returns an option as a user writes it: ``missing="skip"``, or ``--missing skip`` on the command line."""
    command = _command.get()
    if command is None:
        return name if value is None else f'{name}="{value}"'
    flag = f"{command}--{_FLAGS.get(name, name).replace('_', '-')}"
    return flag if value is None else f"{flag} {value}"
