"""Atomic file writes, and file errors that name the file."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

STANDARD_OUTPUT = Path("standard output")
"""Name of the standard output in error messages."""


def cache_folder() -> Path:
    """Returns the folder of the cache: ``rover_rl`` in ``XDG_CACHE_HOME``, by default in ``~/.cache``."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG base directory specification: a relative path is ignored.
    return (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "rover_rl"


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Writes a file atomically: yields a temporary path next to ``path`` and renames it to ``path`` at the end.

    Raises:
        OSError: if ``path`` is a folder or cannot be written, for example on a full disk. The error names ``path``.
    """
    # The suffix stays because it determines the format of images.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    with errors_name(path, temporary):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        try:
            yield temporary
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)


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
