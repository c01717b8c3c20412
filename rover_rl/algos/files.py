"""Writing files so that nobody ever sees half of one."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """A temporary path beside ``path`` to write to, moved there in the end: nobody sees half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The suffix stays, because it decides on the format of pictures.
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, data: Any) -> None:
    """Writes plain data as JSON."""
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(data, indent=2) + "\n")
