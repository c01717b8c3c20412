"""Lists the commands of ``rover-rl`` with their ``--help``, read at build time, in place of ``<!-- commands -->``."""

from __future__ import annotations

import io
import os
import re
from contextlib import redirect_stdout, suppress
from typing import Any
from unittest.mock import patch

from sphinx.application import Sphinx

from rover_rl.cli.main import commands, main

MARKER = "<!-- commands -->"


def setup(app: Sphinx) -> dict[str, Any]:
    """Adds the list to a build."""
    app.connect("source-read", list_commands)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}


def list_commands(app: Sphinx, document: str, source: list[str]) -> None:
    """Replaces the marker in a page by a table of the commands, and a section for each."""
    if MARKER not in source[0]:
        return
    # The help comes from code, whose changes Sphinx does not see.
    app.env.note_reread()
    rows, sections = [], []
    for command in all_commands():
        text = command_help(command)
        summary = text.split("\n\n")[1].split(". ")[0].rstrip(".")
        if "--algo" not in command:
            rows.append(f"| [`rover-rl {command}`](#rover-rl-{command.replace(' ', '-')}) | {summary} |")
        sections.append(f"## rover-rl {command}\n\n```text\n{text}\n```\n")
    source[0] = source[0].replace(MARKER, "\n".join(["| command | what it does |", "|---|---|", *rows, "", *sections]))


def all_commands() -> list[str]:
    """Returns all commands and subcommands; ``train`` with both algorithms."""
    names = []
    for command in commands():
        names += [command, "train --algo sac"] if command == "train" else [command]
        names += [f"{command} {name}" for name in re.findall(r"• (?!list)(\w+)", command_help(command))]
    return names


def command_help(command: str) -> str:
    """Returns what ``rover-rl COMMAND --help`` prints."""
    text = io.StringIO()
    with redirect_stdout(text), suppress(SystemExit), patch.dict(os.environ, COLUMNS="100"):
        main([*command.split(), "--help"])
    return text.getvalue().strip()
