"""Writing files so that nobody ever sees half of one, and errors that say which file could not be written."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

STANDARD_OUTPUT = Path("standard output")
"""What to call it in an error."""


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to, moved there in the end: nobody sees half a file.

    Raises:
        OSError: naming ``path``, if the disk is full, or ``path`` is a folder or may not be written.
    """
    # The suffix stays, because it decides on the format of pictures.
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
    """Makes the system's errors name ``path``: a write that fails names no file, or the ``temporary`` one."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_through(path: Path, data: bytes | memoryview) -> None:
    """Writes a file, and waits until the disk has all of it.

    Raises:
        OSError: naming ``path``.
    """
    with errors_name(path), path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def write_json(path: Path, data: Any) -> None:
    """Writes plain data as JSON."""
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2) + "\n")
