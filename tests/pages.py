"""The Markdown pages of the project, read with a CommonMark parser that knows GitHub's tables."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from markdown_it import MarkdownIt
from markdown_it.token import Token

ROOT = Path(__file__).parents[1]
_MARKDOWN = MarkdownIt("commonmark").enable("table")
_DEFINITIONS = (ast.Import, ast.ImportFrom, ast.FunctionDef, ast.ClassDef)
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


def definitions(text: str, name: str) -> str:
    """Returns the imports, functions and classes of the first Python block that defines a name."""
    for block in blocks(text, "python"):
        found = [node for node in ast.parse(block.code).body if isinstance(node, _DEFINITIONS)]
        if name in {getattr(node, "name", None) for node in found}:
            return ast.unparse(ast.Module(found, []))
    raise LookupError(name)


def documented(page: str, name: str) -> Any:
    """Returns the class or function that a page in ``docs/`` defines."""
    names: dict[str, Any] = {"__name__": __name__}
    exec(definitions((ROOT / "docs" / page).read_text(encoding="utf-8"), name), names)
    return names[name]


def inline(text: str, kind: str) -> Iterator[Token]:
    """Yields the tokens of a kind within paragraphs, headings and cells, such as ``"code_inline"``."""
    return (child for token in tokens(text) for child in token.children or () if child.type == kind)
