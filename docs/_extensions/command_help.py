"""The directive ``command-help``: documents a command of ``rover-rl`` by its ``--help``, read at build time."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout
from typing import Any, ClassVar
from unittest.mock import patch

from docutils import nodes
from docutils.parsers.rst import directives
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from rover_rl.cli.main import commands, main

COLUMNS = "110"
"""Width of the terminal in which the help is printed: a wider one has two columns of options."""


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
    app.add_directive("command-help", CommandHelp)
    app.connect("source-read", list_commands)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}


class CommandHelp(SphinxDirective):
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
        usage, description, boxes = read_help(self.arguments[0])
        prefix = nodes.make_id(f"rover-rl {self.arguments[0]}")
        known = {head for group in self._other_options() for head, _ in group}
        yielded = [nodes.literal_block(_plain(usage), _plain(usage), language="text")]
        yielded += [nodes.paragraph("", "", *_words(text)) for text in description]
        for title, options in boxes.items():
            options = [(head, text) for head, text in options if head not in known]
            if not options:
                continue
            yielded += [nodes.rubric(text=title[:1].upper() + title[1:]), _options(options, prefix)]
        return yielded

    def _other_options(self) -> Iterable[list[tuple[str, list[str]]]]:
        return read_help(self.options["beside"])[2].values() if "beside" in self.options else []


def list_commands(app: Sphinx, document: str, source: list[str]) -> None:
    """Replaces ``<!-- commands -->`` in a page by a section for each command."""
    if MARKER not in source[0]:
        return
    rows, sections = [], []
    for command in all_commands():
        summary = read_help(command)[1][0].split(". ")[0].rstrip(".")
        rows.append(f"| [`rover-rl {command}`](#rover-rl-{command.replace(' ', '-')}) | {summary} |")
        beside = "   :beside: train\n" if command == "sweep" else ""
        sections.append(f"## rover-rl {command}\n\n```{{eval-rst}}\n.. command-help:: {command}\n{beside}```\n")
        if command == "train":
            sections.append(SAC)
    source[0] = source[0].replace(MARKER, "\n".join(["| command | what it does |", "|---|---|", *rows, "", *sections]))


def all_commands() -> list[str]:
    """Returns all commands, with the subcommands of those that have no options of their own."""
    names = []
    for command in commands():
        usage, _, boxes = read_help(command)
        subcommands = re.search(r"{([a-z,-]+)}$", usage)
        names += [f"{command} {name}" for name in subcommands[1].split(",")] if subcommands and not boxes else [command]
    return names


def read_help(command: str) -> tuple[str, list[str], dict[str, list[tuple[str, list[str]]]]]:
    """Returns the usage of a command, its description, and options with their help by group.

    Args:
        command: words after ``rover-rl``, such as ``"train --algo sac"``.
    """
    head, *rest = re.split(r"\n (?=\S[^\n]*\n -{20,}\n)", help_text(command))
    usage, *description = [" ".join(part.split()) for part in head.split("\n\n") if part.strip()]
    boxes: dict[str, list[tuple[str, list[str]]]] = {}
    for box in rest:
        title, _, body = box.partition("\n")
        options = [(head, text) for head, text in _entries(body) if not head.startswith("-h")]
        if options:
            boxes[title.strip()] = options
    return usage.removeprefix("usage: ").replace(" [-h]", ""), description, boxes


def help_text(command: str) -> str:
    """Returns what ``rover-rl COMMAND --help`` prints, without box-drawing characters.

    Raises:
        RuntimeError: if the command prints no help.
    """
    output = io.StringIO()
    with patch.dict(os.environ, COLUMNS=COLUMNS), redirect_stdout(output):
        try:
            main([*command.split(), "--help"])
        except SystemExit as stop:
            if not stop.code:
                return "\n".join(line.rstrip() for line in output.getvalue().splitlines()) + "\n"
    raise RuntimeError(f"'rover-rl {command} --help' failed")


def _entries(body: str) -> Iterator[tuple[str, list[str]]]:
    """Yields each option of a group, such as ``"--world STR"``, with the lines of its help."""
    head, text = "", []
    for line in body.splitlines():
        starts = re.match(r"  (\S.*?)(?:\s{2,}(\S.*))?$", line)
        if re.match(r" *-{20,}$", line) or not line.strip():
            continue
        if starts and (starts[1].startswith("-") or re.fullmatch(r"[A-Z|{}\[\] .]+", starts[1])):
            if head:
                yield head, text
            head, text = starts[1], [starts[2]] if starts[2] else []
        elif head:
            text = [*text, line.strip()]
    if head:
        yield head, text


def _options(options: list[tuple[str, list[str]]], prefix: str) -> nodes.definition_list:
    listed = nodes.definition_list(classes=["command-options"])
    for head, text in options:
        name = nodes.make_id(f"{prefix} {head.split()[0]}")
        term = nodes.term("", "", nodes.literal(text=_plain(head)), ids=[name])
        line = re.sub(r" ?\(default: (None)?\)$", "", " ".join(text))
        definition = nodes.definition("", nodes.paragraph("", "", *_words(line)))
        listed += nodes.definition_list_item("", term, definition)
    return listed


def _words(text: str) -> list[nodes.Node]:
    """Returns a text with its options, pages and code as literals."""
    parts = re.split(r"``(.+?)``|((?<!\S)--[a-z][\w.-]*\w|\bdocs/\w+\.md)", text)
    texts, *codes = parts[::3], parts[1::3], parts[2::3]
    found: list[nodes.Node] = []
    for number, plain in enumerate(texts):
        found.append(nodes.Text(plain))
        found += [nodes.literal(text=code[number]) for code in codes if number < len(code) and code[number]]
    return found


def _plain(head: str) -> str:
    """Returns an option without the parser's notation for values that may be left out or repeated."""
    head = re.sub(r"\{None\}\||\|\{\[STR \[STR \.\.\.\]\]\}", "", head)
    return re.sub(r"\[+(\w+(?: \w+)*) \[\1 \.\.\.\]\]+", r"\1 ...", head)
