"""The README and the pages in ``docs/``: their tables, Python blocks, commands and links are right."""

from __future__ import annotations

import importlib.util
import io
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import tyro

from rover_rl.algos.config import training_config
from rover_rl.algos.config_files import write_config
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.cli.main import commands as all_commands
from rover_rl.cli.main import main, read_command
from tests.pages import NEEDS, ROOT, anchors, blocks, broken_tables, inline, name_of, pages, tokens

ALL = pytest.mark.parametrize("page", [pytest.param(page, id=name_of(page)) for page in pages()])
WITH_PYTHON = [page for page in pages() if blocks(page.read_text(encoding="utf-8"), "python")]
SCRIPTS = [
    block.code
    for page in WITH_PYTHON
    for block in blocks(page.read_text(encoding="utf-8"), "python")
    if "__main__" in block.code
]
OPERATORS = {"&&", "||", ";", "|"}


def load(path: Path) -> ModuleType:
    """Imports a file that belongs to no package."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# Tables


@ALL
def test_tables_are_tables(page: Path) -> None:
    assert broken_tables(page.read_text(encoding="utf-8")) == []


# Figures


MEASURED = re.compile(r"\d (?:%|s\b|goals)|\d\.\d")


def tables(text: str) -> Iterator[str]:
    """Yields the Markdown of each table of a page."""
    for token in tokens(text):
        if token.type == "table_open" and token.map:
            yield "\n".join(text.splitlines()[slice(*token.map)])


def without_planner(text: str) -> list[str]:
    """Returns the tables with figures of ``anywhere`` that lack ``gridplanner``, to whose action that policy adds."""
    measured = (table for table in tables(text) if re.search(r"\banywhere\b", table) and MEASURED.search(table))
    return [table for table in measured if "gridplanner" not in table]


@ALL
def test_tables_with_anywhere_show_the_planner_beside_it(page: Path) -> None:
    assert without_planner(page.read_text(encoding="utf-8")) == []


OUTDATED = re.compile(r"measured (?:when|before)|stronger than\s+set|before \S+ friction was", re.IGNORECASE)


@ALL
def test_no_figure_is_of_physics_since_changed(page: Path) -> None:
    """Figures that a page itself calls older than today's physics are measured again or removed, not annotated."""
    assert OUTDATED.findall(page.read_text(encoding="utf-8")) == []


def test_every_picture_of_the_pages_is_shown() -> None:
    """A picture whose figures are outdated goes with the text that showed it."""
    shown = "\n".join(page.read_text(encoding="utf-8") for page in pages())
    shown += "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "examples").glob("*.py"))
    assert [path.name for path in (ROOT / "docs/images").iterdir() if path.name not in shown] == []


# Python


def shortened(code: str) -> str:
    """Shortens or leaves out training, which has its own tests, and makes large batches small."""
    code = re.sub(r"\.learn\([\d_]+\)", "", code)
    code = re.sub(r"\b1_000\b", "100", code)
    code = re.sub(r"total_frames=\d+_000", "total_frames=320", code)
    code = re.sub(r"\brollout\(\d{3}\b", "rollout(10", code)
    code = code.replace(".first(8)", ".first(1)")
    return code.replace("num_envs=4096", "num_envs=64")


def test_there_are_python_blocks_of_each_kind() -> None:
    assert len(WITH_PYTHON) >= 10
    assert len(SCRIPTS) >= 2
    assert any(block.code.startswith(NEEDS) for page in WITH_PYTHON for block in blocks(page.read_text(), "python"))


@pytest.mark.parametrize("page", [pytest.param(page, id=name_of(page)) for page in WITH_PYTHON])
@pytest.mark.usefixtures("own_registries", "capsys")
def test_python_blocks_run(page: Path) -> None:
    """Blocks run one after another, as a reader would run them, apart from those that need a rover."""
    names: dict[str, object] = {}
    for block in blocks(page.read_text(encoding="utf-8"), "python"):
        code = compile(shortened(block.code), f"{name_of(page)}:{block.line}", "exec")
        if not block.code.startswith(NEEDS) and "__main__" not in block.code:
            exec(code, names)


@pytest.mark.slow
def test_python_blocks_that_start_processes_run(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text("\n".join(SCRIPTS))
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, script], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("(") >= len(SCRIPTS)


# Commands


def scripted_commands(text: str) -> Iterator[list[str]]:
    """Yields the words of each command in the bash blocks and indented blocks of a page, less variables before it."""
    for token in tokens(text):
        if token.type == "code_block" or (token.type == "fence" and token.info == "bash"):
            for line in token.content.replace("\\\n", " ").splitlines():
                yield from split_commands(line)


def mentioned_commands(text: str) -> Iterator[list[str]]:
    """Yields the words of each inline code of a page that may be a command, whole or not."""
    for code in inline(text, "code_inline"):
        try:
            yield from split_commands(code.content)
        except ValueError:  # an apostrophe
            continue


def split_commands(line: str) -> Iterator[list[str]]:
    """Yields the words of each command of a line, without comments and variables."""
    words = shlex.split(line, comments=True)
    while words:
        end = next((number for number, word in enumerate(words) if word in OPERATORS), len(words))
        command, words = words[:end], words[end + 1 :]
        while command and re.match(r"[A-Z_]+=", command[0]):
            command = command[1:]
        if command:
            yield command


def commands(*start: str, mentioned: bool = True, scripted: bool = True) -> list[Any]:
    """Returns the commands of all pages that begin with the words ``start``, less these, as parameters of a test."""
    found = {}
    for page in pages():
        text = page.read_text(encoding="utf-8")
        lines = [*(scripted_commands(text) if scripted else ()), *(mentioned_commands(text) if mentioned else ())]
        for command in lines:
            if command[: len(start)] == list(start) and len(command) > len(start):
                found[f"{name_of(page)}: {' '.join(command)}"] = command[len(start) :]
    return [pytest.param(rest, id=key) for key, rest in found.items()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run that the pages resume and repeat."""
    folder = tmp_path_factory.mktemp("pages")
    write_config(folder / "runs/ppo-moon/config.yaml", training_config("ppo", world="moon"))
    load_pretrained("moon-ppo").save(folder / "runs/ppo-moon/checkpoint.pt")
    return folder


@cache
def options_of(command: str) -> set[str]:
    """Returns the options of a command of ``rover-rl``; for ``train``, those of both algorithms."""
    found = {"--help"}
    for words in ([command], [command, "--algo", "sac"]) if command == "train" else ([command],):
        output = io.StringIO()
        with redirect_stdout(output), pytest.raises(SystemExit):
            main([*words, "--help"])
        found.update(re.findall(r"--[a-z][\w.-]*", output.getvalue()))
    return found


@pytest.mark.parametrize("args", commands("rover-rl", mentioned=False))
@pytest.mark.usefixtures("capsys")
def test_commands_are_understood(args: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert callable(read_command(args))


@pytest.mark.parametrize("args", commands("rover-rl", scripted=False))
def test_mentioned_commands_and_their_options_exist(args: list[str]) -> None:
    if args[0] in ("COMMAND", "--help", "--version"):
        return
    assert args[0] in all_commands()
    assert {word.split("=")[0] for word in args if word.startswith("--")} <= options_of(args[0])


@pytest.mark.parametrize("args", commands("make"))
def test_targets_of_make_exist(args: list[str]) -> None:
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert args[0] in targets


@pytest.mark.parametrize("args", commands("python"))
def test_python_programs_and_their_arguments_exist(args: list[str]) -> None:
    if args[0] == "-c":
        compile(args[1], "<page>", "exec")
        return
    named, *options = args[1:] if args[0] == "-m" else args
    if args[0] == "-m" and not (ROOT / named.partition(".")[0]).is_dir():
        assert find_spec(named) is not None
        return
    path = ROOT / (named.replace(".", "/") if args[0] == "-m" else named)
    path = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
    assert path.is_file()
    if path.is_relative_to(ROOT / "benchmarks"):
        name = "benchmarks" if path.name == "__main__.py" else f"benchmarks.{path.stem}"
        module = import_module("benchmarks.__main__" if name == "benchmarks" else name)
        tyro.cli(getattr(module, "Bench", None) or module.Options, args=options)


@pytest.mark.parametrize("args", commands("pip", "install"))
def test_extras_exist(args: list[str]) -> None:
    section = (ROOT / "pyproject.toml").read_text().split("[project.optional-dependencies]")[1].split("\n[")[0]
    extras = re.findall(r"^(\w+) = \[", section, re.MULTILINE)
    asked = [extra for word in args for names in re.findall(r"\[([\w,]+)\]", word) for extra in names.split(",")]
    assert set(asked) <= set(extras)
    # The name is not on a package index yet.
    assert not any(re.match(r"rover[-_]rl\b(?!.*\.whl)", word) for word in args)


def test_there_are_commands_of_each_kind() -> None:
    assert {command.values[0][0] for command in commands("rover-rl", mentioned=False)} >= {"train", "evaluate", "drive"}
    for start in (("make",), ("python", "-m", "benchmarks"), ("pip", "install")):
        assert len(commands(*start)) >= 2


# Links


def links(page: Path) -> Iterator[str]:
    """Yields the links and pictures of a page, of Markdown and of HTML."""
    text = page.read_text(encoding="utf-8")
    yield from (str(token.attrs["href"]) for token in inline(text, "link_open"))
    yield from (str(token.attrs["src"]) for token in inline(text, "image"))
    html = [token.content for token in tokens(text) if token.type == "html_block"]
    html += [token.content for token in inline(text, "html_inline")]
    for part in html:
        yield from re.findall(r'(?:href|src|srcset)="([^"]+)"', part)


def broken_links(page: Path) -> list[str]:
    """Returns the relative links of a page to files or headings that do not exist."""
    broken = []
    for url in links(page):
        parts = urlsplit(url)
        if parts.scheme or parts.netloc:
            continue
        target = (page.parent / unquote(parts.path)).resolve() if parts.path else page
        if not target.exists() or (parts.fragment and parts.fragment not in anchors(target)):
            broken.append(url)
    return broken


@ALL
def test_links_resolve(page: Path) -> None:
    assert broken_links(page) == []


def test_the_built_site_is_checked_too(tmp_path: Path) -> None:
    check = load(ROOT / "docs" / "check_links.py")
    (tmp_path / "index.html").write_text('<h1 id="top">A</h1> <a href="#top">b</a> <a href="https://example.org">c</a>')
    assert check.broken_links(tmp_path) == []
    (tmp_path / "index.html").write_text(
        '<a href="#gone">a</a> <img src="gone.png"> <script src="https://a.b/c"></script>'
    )
    assert len(check.broken_links(tmp_path)) == 3
    with pytest.raises(FileNotFoundError, match="make docs"):
        check.broken_links(tmp_path / "docs")


# The README and the site


def test_the_readme_names_make_demo_and_make_test() -> None:
    assert "make demo" in (ROOT / "README.md").read_text()
    assert "make test" in (ROOT / "README.md").read_text()


def test_the_command_line_reference_has_every_command_with_its_options() -> None:
    pytest.importorskip("sphinx")
    help_ = load(ROOT / "docs" / "_extensions" / "command_help.py")
    documented = help_.all_commands()
    assert {*all_commands(), "worlds import", "benchmark barn", "train --algo sac"} <= {*documented}
    for command in documented:
        assert options_of(command.split()[0]) & {*re.findall(r"--[a-z][\w.-]*", help_.command_help(command))}


def test_every_example_has_a_place_in_the_gallery() -> None:
    pytest.importorskip("sphinx")
    gallery = load(ROOT / "docs" / "_extensions" / "gallery.py")
    assert {path.name for path in (ROOT / "examples").glob("*.py")} == set(gallery.ORDER)
