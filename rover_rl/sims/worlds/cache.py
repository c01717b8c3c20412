"""Results on disk, found by the content that they were computed from."""

from __future__ import annotations

import hashlib
import io
import os
import zipfile
from pathlib import Path

import numpy as np

from rover_rl.files import written_whole


def cache_folder() -> Path:
    """Returns the folder of the cache: ``rover_rl`` in ``XDG_CACHE_HOME``, by default in ``~/.cache``."""
    given = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG base directory specification: a relative path is ignored.
    return (Path(given) if os.path.isabs(given) else Path.home() / ".cache") / "rover_rl"


def content_key(*parts: bytes | str) -> str:
    """Returns a key of content: the SHA-256 hash of its parts."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()


def load_arrays(kind: str, key: str) -> dict[str, np.ndarray] | None:
    """Returns the arrays that are stored under a key. ``None`` if there are none, or the file is damaged."""
    try:
        with np.load(_path(kind, key), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError):
        return None
    except Exception as error:  # zipfile.BadZipFile and zlib.error have no common class
        if type(error).__module__ in ("zipfile", "zlib"):
            return None
        raise


def store_arrays(kind: str, key: str, arrays: dict[str, np.ndarray]) -> None:
    """Stores arrays under a key. Several processes may do so at once. A full or read-only disk is no error."""
    content = io.BytesIO()
    # The fastest compression takes a third of the time of NumPy's, which is the greater part of storing small arrays.
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, array, allow_pickle=False)
    try:
        with written_whole(_path(kind, key)) as temporary:
            temporary.write_bytes(content.getvalue())
    except OSError:
        pass


def _path(kind: str, key: str) -> Path:
    return cache_folder() / kind / f"{key}.npz"
