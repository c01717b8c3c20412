"""The Markdown pages of the project, read with a CommonMark parser that knows GitHub's tables."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).parents[1]
_MARKDOWN = MarkdownIt("commonmark").enable("table")
# Blocks that start with such a comment are compiled and not run.
NEEDS = "# needs "


class Block(NamedTuple):
    """A code block: the line on which its code starts, and the code."""

    line: int
    code: str


def pages() -> list[Path]:
    """Returns the pages at the root, in ``docs/`` and beside the pretrained policies."""
    top = [ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]
    docs = [
        path
        for path in sorted((ROOT / "docs").rglob("*.md"))
        if not {"_build", "gallery"} & {*path.relative_to(ROOT).parts}
    ]
    return [*filter(Path.is_file, top), *docs, *sorted((ROOT / "rover_rl/algos/pretrained").glob("*.md"))]


def name_of(page: Path) -> str:
    """Returns the path of a page within the project."""
    return page.relative_to(ROOT).as_posix()


def tokens(text: str) -> list[Token]:
    """Parses Markdown. Front matter and the colons around MyST's directives are read as text."""
    return _MARKDOWN.parse(text)


def blocks(text: str, language: str) -> list[Block]:
    """Returns the fenced blocks of a language."""
    return [
        Block(token.map[0] + 2, token.content)
        for token in tokens(text)
        if token.type == "fence" and token.info == language and token.map
    ]


def inline(text: str, kind: str) -> Iterator[Token]:
    """Yields the tokens of a kind within paragraphs, headings and cells, such as ``"code_inline"``."""
    return (child for token in tokens(text) for child in token.children or () if child.type == kind)


def anchors(page: Path) -> set[str]:
    """Returns the anchors of the headings of a page and of what it includes, as GitHub and MyST make them."""
    text = page.read_text(encoding="utf-8")
    found: set[str] = set()
    parsed = tokens(text)
    for heading, content in pairwise(parsed):
        if heading.type == "heading_open":
            words = "".join(child.content for child in content.children or ())
            found.add(re.sub(r"[^\w\- ]", "", words.strip().lower()).replace(" ", "-"))
    for include in re.findall(r"^```\{include\} (\S+)$", text, re.MULTILINE):
        found |= anchors(page.parent / include)
    return found


def broken_tables(text: str) -> list[str]:
    """Returns what is wrong with the tables of a page: rows of unequal length, and rows outside of a table.

    The parser fills short rows and cuts long ones, so cells are counted in the text. A row outside of a table is one
    that a blank line or a wrong line of dashes has cut off.
    """
    lines = text.splitlines()
    within: set[int] = set()
    problems = []
    for token in tokens(text):
        if token.type in ("fence", "code_block", "html_block") and token.map:
            within.update(range(*token.map))
        elif token.type == "table_open" and token.map:
            rows = range(*token.map)
            within.update(rows)
            cells = len(_cells(lines[rows.start]))
            problems += [
                f"line {row + 1} has {len(_cells(lines[row]))} cells instead of {cells}: {lines[row]}"
                for row in rows
                if len(_cells(lines[row])) != cells
            ]
    return problems + [
        f"line {number + 1} is outside of a table: {line}"
        for number, line in enumerate(lines)
        if line.lstrip().startswith("|") and number not in within
    ]


def _cells(row: str) -> list[str]:
    """Returns the cells of a row. A bar separates cells in code, too, unless a backslash precedes it."""
    return re.split(r"(?<!\\)\|", re.sub(r"(?<!\\)\|$", "", row.strip().removeprefix("|")))
