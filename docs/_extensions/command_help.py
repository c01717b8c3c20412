"""The directive ``command-help``: documents a command of ``rover-rl`` by its ``--help``, read at build time."""

from __future__ import annotations

import re
from typing import Any, ClassVar

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from rover_rl.cli.help import grouped, usage
from rover_rl.cli.main import commands
from rover_rl.cli.parsing import SUBCOMMANDS, CommandHelp, Option, read_help

MARKER = "<!-- commands -->"
SAC = """### Options of SAC

`rover-rl train --algo sac` has these in place of PPO's:

```{eval-rst}
.. command-help:: train --algo sac
   :beside: train
```
"""


def setup(app: Sphinx) -> dict[str, Any]:
    """Adds the directive to a build."""
    app.add_directive("command-help", HelpDirective)
    app.connect("source-read", list_commands)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}


class HelpDirective(SphinxDirective):
    """Documents a command: its usage, its description and its options.

    The option ``beside`` names another command, whose options are left out.

    Example:
        .. command-help:: train --algo sac
           :beside: train
    """

    required_arguments = 1
    final_argument_whitespace = True
    option_spec: ClassVar[dict[str, Any]] = {"beside": directives.unchanged_required}

    def run(self) -> list[nodes.Node]:
        """Returns the usage, the description and the options of the command."""
        # The help comes from code, whose changes Sphinx does not see.
        self.env.note_reread()
        command = self.arguments[0]
        found = command_help(command)
        prefix = nodes.make_id(f"rover-rl {command}")
        known = command_help(self.options["beside"]).options if "beside" in self.options else []
        yielded = [nodes.literal_block(usage(found), usage(found), language="text")]
        yielded += [nodes.paragraph("", "", *_words(text)) for text in found.description]
        for title, options in grouped(found).items():
            if options := [option for option in options if option not in known]:
                yielded += [nodes.rubric(text=title), _options(options, prefix)]
        return yielded


def list_commands(app: Sphinx, document: str, source: list[str]) -> None:
    """Replaces ``<!-- commands -->`` in a page by a section for each command."""
    if MARKER not in source[0]:
        return
    rows, sections = [], []
    for command in all_commands():
        summary = command_help(command).description[0].split(". ")[0].rstrip(".")
        rows.append(f"| [`rover-rl {command}`](#rover-rl-{command.replace(' ', '-')}) | {summary} |")
        beside = "   :beside: train\n" if command == "sweep" else ""
        sections.append(f"## rover-rl {command}\n\n```{{eval-rst}}\n.. command-help:: {command}\n{beside}```\n")
        if command == "train":
            sections.append(SAC)
    source[0] = source[0].replace(MARKER, "\n".join(["| command | what it does |", "|---|---|", *rows, "", *sections]))


def all_commands() -> list[str]:
    """Returns all commands that have options, and subcommands."""
    names = []
    for command in commands():
        found = command_help(command)
        subcommands = [option.head for option in found.boxes.get(SUBCOMMANDS, ()) if option.text]
        names += [command] if found.options else []
        names += [f"{command} {name}" for name in subcommands]
    return names


def command_help(command: str) -> CommandHelp:
    """Reads the help of a command.

    Args:
        command: words after ``rover-rl``, such as ``"train --algo sac"``.
    """
    return read_help(commands(command.split()), command)


def _options(options: list[Option], prefix: str) -> nodes.definition_list:
    listed = nodes.definition_list(classes=["command-options"])
    for option in options:
        name = nodes.make_id(f"{prefix} {option.head.split()[0]}")
        term = nodes.term("", "", nodes.literal(text=option.head), ids=[name])
        definition = nodes.definition("", nodes.paragraph("", "", *_words(option.text)))
        listed += nodes.definition_list_item("", term, definition)
    return listed


def _words(text: str) -> list[nodes.Node]:
    """Returns a text with its options, pages and code as literals."""
    parts = re.split(r"((?<!\S)--[a-z][\w.-]*\w|\bdocs/\w+\.md)", text)
    return [nodes.literal(text=part) if number % 2 else nodes.Text(part) for number, part in enumerate(parts)]
