"""Results on disk, found by the content that they were computed from, such as a world."""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from functools import lru_cache
from pathlib import Path

import numpy as np

from rover_rl.files import cache_folder, written_whole

KEPT_BYTES = 2**30
"""Size of the files of a kind, above which the oldest ones are deleted."""
FOLDERS = 256
"""Number of folders that the files of a kind are spread over."""


def content_key(*parts: bytes | str) -> str:
    """SHA-256 hash of content in parts."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()


@lru_cache(maxsize=16)
def code_key(*folders: Path) -> str:
    """Returns a key of the modules in folders: what another version of them stored is not found."""
    return content_key(*(path.read_bytes() for folder in folders for path in sorted(folder.glob("*.py"))))


def load_arrays(kind: str, key: str) -> dict[str, np.ndarray] | None:
    """Returns the arrays that are stored under a key. ``None`` if there are none, or the file is damaged."""
    try:
        with np.load(_path(kind, key), allow_pickle=False) as stored:
            return dict(stored)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return None


def store_arrays(kind: str, key: str, arrays: dict[str, np.ndarray]) -> None:
    """Stores arrays of numbers under a key. Several processes may do so at once. A full disk is no error."""
    path = _path(kind, key)
    try:
        with written_whole(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        kept = 0
        for other in sorted(path.parent.iterdir(), key=lambda file: file.stat().st_mtime_ns, reverse=True):
            kept += other.stat().st_size
            if kept > KEPT_BYTES / FOLDERS and other != path:
                # Another process may have deleted it.
                other.unlink(missing_ok=True)
    except OSError:
        pass


def _path(kind: str, key: str) -> Path:
    return cache_folder() / kind / key[:2] / f"{key}.npz"
