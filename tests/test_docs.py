"""The README and the pages in ``docs/``: their tables, commands and options are right.

Their Python blocks run in ``test_examples.py``, and ``docs/check_links.py`` checks their links.
"""

from __future__ import annotations

import importlib.util
import io
import re
import shlex
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest
import tyro

from rover_rl.algos.config import training_config
from rover_rl.algos.config_files import write_config
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.cli.main import commands as all_commands
from rover_rl.cli.main import main, read_command
from tests.pages import ROOT, inline, name_of, pages, tokens

OPERATORS = {"&&", "||", ";", "|"}
TEXTS = {name_of(page): page.read_text(encoding="utf-8") for page in pages()}


def test_rows_of_a_table_have_as_many_cells_as_its_head() -> None:
    """The parser fills short rows and cuts long ones: bars are counted, except those after a backslash."""
    for name, text in TEXTS.items():
        for token in tokens(text):
            if token.type == "table_open" and token.map:
                rows = text.splitlines()[slice(*token.map)]
                assert len({len(re.findall(r"(?<!\\)\|", row)) for row in rows}) == 1, (name, rows)
            elif token.type == "inline":
                assert not token.content.startswith("|"), f"{name}: a row outside of a table: {token.content}"


def test_every_picture_of_the_pages_is_shown() -> None:
    """A picture whose figures are outdated goes with the text that showed it."""
    shown = "\n".join([*TEXTS.values(), *(path.read_text(encoding="utf-8") for path in ROOT.glob("examples/*.py"))])
    assert [path.name for path in (ROOT / "docs/images").iterdir() if path.name not in shown] == []


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


def commands(*start: str, mentioned: bool = True, scripted: bool = True) -> list[list[str]]:
    """Returns the commands of all pages that begin with the words ``start``, less these: at least two."""
    kinds = [*([scripted_commands] if scripted else []), *([mentioned_commands] if mentioned else [])]
    found = [command for text in TEXTS.values() for kind in kinds for command in kind(text)]
    found = [command[len(start) :] for command in found if command[: len(start)] == [*start] != command]
    assert len(found) >= 2
    return found


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


@pytest.mark.usefixtures("capsys")
def test_commands_are_understood(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    read: set[str] = set()
    # A parser takes a second: commands whose options longer ones had are not read again.
    for args in sorted(commands("rover-rl", mentioned=False), key=len, reverse=True):
        options = {f"{args[0]} {word}" for word in args if word.startswith("-")} | {args[0]}
        if options <= read:
            continue
        read |= options
        try:
            assert callable(read_command(args))
        except (Exception, SystemExit) as error:
            pytest.fail(f"rover-rl {shlex.join(args)}: {error}")


def test_mentioned_commands_and_their_options_exist() -> None:
    for args in commands("rover-rl", scripted=False):
        if args[0] not in ("COMMAND", "--help", "--version"):
            assert args[0] in all_commands()
            assert {word.split("=")[0] for word in args if word.startswith("--")} <= options_of(args[0]), args


def test_targets_of_make_exist() -> None:
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {args[0] for args in commands("make")} <= {*targets}


def test_python_programs_and_their_arguments_exist() -> None:
    for args in commands("python"):
        if args[0] == "-c":
            compile(args[1], "<page>", "exec")
            continue
        named, *options = args[1:] if args[0] == "-m" else args
        if args[0] == "-m" and not (ROOT / named.partition(".")[0]).is_dir():
            assert find_spec(named) is not None
            continue
        path = ROOT / (named.replace(".", "/") if args[0] == "-m" else named)
        path = path / "__main__.py" if path.is_dir() else path.with_suffix(".py")
        assert path.is_file(), args
        if path.is_relative_to(ROOT / "benchmarks"):
            module = import_module(".".join(path.relative_to(ROOT).with_suffix("").parts))
            tyro.cli(getattr(module, "Bench", None) or module.Options, args=options)


def test_extras_exist() -> None:
    section = (ROOT / "pyproject.toml").read_text().split("[project.optional-dependencies]")[1].split("\n[")[0]
    extras = re.findall(r"^(\w+) = \[", section, re.MULTILINE)
    for args in commands("pip", "install"):
        asked = [extra for word in args for names in re.findall(r"\[([\w,]+)\]", word) for extra in names.split(",")]
        assert {*asked} <= {*extras}
        # The name is not on a package index yet.
        assert not any(re.match(r"rover[-_]rl\b(?!.*\.whl)", word) for word in args)


def test_the_command_line_reference_has_every_command_with_its_options() -> None:
    pytest.importorskip("sphinx")
    spec = importlib.util.spec_from_file_location("command_help", ROOT / "docs" / "_extensions" / "command_help.py")
    assert spec is not None
    assert spec.loader is not None
    help_ = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(help_)
    documented = help_.all_commands()
    assert {*all_commands(), "worlds import", "benchmark barn", "train --algo sac"} <= {*documented}
    for command in documented:
        assert options_of(command.split()[0]) & {*re.findall(r"--[a-z][\w.-]*", help_.command_help(command))}
