"""Atomic file writes that say who made the file, the refusal to replace other files, and errors that name the file."""

from __future__ import annotations

import errno
import json
import os
import re
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

STANDARD_OUTPUT = Path("standard output")
"""Name of the standard output in error messages."""
MADE = "rover_rl made this file and may write over it"
"""Mark in the files that this package writes for users, by which :func:`check_outputs` knows them."""
MADE_BY = {"made_by": MADE}
"""The mark in a JSON object."""

_MARK = MADE.encode()
_PNG_TEXT = b"tEXtComment\0" + _MARK
_MARKS = {
    # Before the last chunk of a PNG file, as a chunk of text: length, text, checksum.
    ".png": (12, len(_PNG_TEXT[4:]).to_bytes(4, "big") + _PNG_TEXT + zlib.crc32(_PNG_TEXT).to_bytes(4, "big")),
    # Before the last byte of a GIF file, as a comment.
    ".gif": (1, b"\x21\xfe" + bytes((len(_MARK),)) + _MARK + b"\0"),
    # Before the last marker of a JPEG file, as a comment.
    **dict.fromkeys((".jpg", ".jpeg"), (2, b"\xff\xfe" + (len(_MARK) + 2).to_bytes(2, "big") + _MARK)),
    # In a box that is skipped.
    ".mp4": (0, (len(_MARK) + 8).to_bytes(4, "big") + b"free" + _MARK),
    # As the comment of a ZIP archive, in place of the length of none.
    **dict.fromkeys((".npz", ".pt2"), (2, len(_MARK).to_bytes(2, "little") + _MARK)),
    **dict.fromkeys((".html", ".htm", ".svg"), (0, b"<!-- " + _MARK + b" -->\n")),
    ".pdf": (0, b"%" + _MARK + b"\n"),
}
"""Number of bytes at the end of a file that the mark comes before, and the mark, by the suffix of the format."""
_CSV = re.compile(rb'"[^",\n]*"(,[^"\n]*)?\r?\n')
"""How a CSV file begins if this package made it: in the first line, the first name alone is quoted."""


def cache_folder() -> Path:
    """Returns the folder of the cache: ``rover_rl`` in ``XDG_CACHE_HOME``, by default in ``~/.cache``."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG base directory specification: a relative path is ignored.
    return (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "rover_rl"


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Writes a file atomically: yields a temporary path next to ``path`` and renames it to ``path`` at the end.

    Raises ``OSError`` that names ``path`` if that is a folder or cannot be written, for example on a full disk.
    """
    # The suffix stays because it determines the format of images.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    with errors_name(path, temporary):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        try:
            yield temporary
            _mark(temporary)
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


def _mark(path: Path) -> None:
    if path.suffix.lower() not in _MARKS:
        return
    before, mark = _MARKS[path.suffix.lower()]
    with path.open("r+b") as file:
        file.seek(-before, os.SEEK_END)
        end = file.read()
        file.seek(-before, os.SEEK_END)
        file.write(mark if end == b"\0\0" else mark + end)


def check_writable(path: Path, option: str) -> None:
    """Checks that a file or folder can be written. Raises ``PermissionError`` with the option that names another."""
    place = next(one for one in path.absolute().parents if os.path.lexists(one))
    if not place.is_dir() or not os.access(place, os.W_OK | os.X_OK):
        reason = "may not be written to" if place.is_dir() else "is no folder"
        raise PermissionError(f"{path} cannot be written, since {place} {reason}: name another place with {option}")


def check_outputs(
    *outputs: Path, inputs: Iterable[str | Path] = (), force: bool = False, option: str = "--out"
) -> None:
    """Checks, before any work, that a command writes over no input and over no file that this package did not make.

    ``outputs`` are files that the command writes, and ``inputs`` what it reads; words that name no file are ignored.
    ``force`` allows it to write over such files, and ``option`` names another place to write to. Raises
    ``PermissionError`` if the place cannot be written to, ``ValueError`` if an output is an input, or two are the same
    file, and ``FileExistsError`` if there is a file that this package did not make.
    """
    read = [Path(word) for word in inputs if os.path.exists(word)]
    for number, path in enumerate(outputs):
        check_writable(path, option)
        if any(path.absolute() == other.absolute() for other in outputs[:number]):
            raise ValueError(f"two results would be written to {path}: name different files")
        if force or not os.path.lexists(path) or path.is_dir():
            continue
        if any(path.exists() and path.samefile(file) for file in read):
            raise ValueError(f"{path} is read by this command: name another file to write, or add --force")
        if not _is_marked(path):
            raise FileExistsError(
                f"{path} is there already, and rover-rl did not make it: name another place to write to, or add --force"
            )


def _is_marked(path: Path) -> bool:
    if not path.is_file():
        return False
    content = path.read_bytes()
    return _MARK in content or (path.suffix.lower() == ".csv" and _CSV.match(content) is not None)


@contextmanager
def errors_name(path: Path, temporary: Path | None = None) -> Iterator[None]:
    """Adds ``path`` to errors of the operating system that name no file, or the ``temporary`` one."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_through(path: Path, data: bytes | memoryview) -> None:
    """Writes a file and flushes it to disk (``fsync``). Errors name ``path``."""
    with errors_name(path), path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def write_json(path: Path, data: Any) -> None:
    """Writes plain data as JSON, atomically."""
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2) + "\n")
