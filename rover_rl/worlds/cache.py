"""Results on disk, found by the content that they were computed from, such as a world."""

from __future__ import annotations

import hashlib
import json
import math
import os
import struct
import zlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np

from rover_rl.files import cache_folder, written_whole
from rover_rl.worlds.obstacles import groups_of

if TYPE_CHECKING:
    from rover_rl.worlds.world import World

KEPT_BYTES = 2**30
"""Size of the files of a kind, above which the oldest ones are deleted."""
FOLDERS = 256
"""Number of folders that the files of a kind are spread over."""
ALIGNMENT = 8
"""Alignment of the arrays of a file in memory, bytes."""


def content_key(*parts: bytes | str) -> str:
    """Returns a key of content: the SHA-256 hash of its parts."""
    digest = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "little") + data)
    return digest.hexdigest()


@lru_cache(maxsize=16)
def code_key(*folders: Path) -> str:
    """Returns a key of the modules in folders: what another version of them stored is not found."""
    return content_key(*(path.read_bytes() for folder in folders for path in sorted(folder.glob("*.py"))))


def world_key(world: World) -> str:
    """Returns a key of the ground, the obstacles and the areas of a world."""
    key = _keys.get(world)
    if key is None:
        key = _keys[world] = content_key(*_content(world))
    return key


_keys: WeakKeyDictionary[World, str] = WeakKeyDictionary()


def _content(world: World) -> Iterator[bytes | str]:
    terrain = world.terrain
    yield repr((terrain.cell, terrain.origin, world.bounds, world.spawn_range, world.goal_range))
    tensors = [terrain.heights]
    for name in ("spawn_region", "goal_region"):
        region = getattr(world, name)
        if region is not None:
            yield repr((name, region.cell, region.origin))
            tensors.append(region.mask)
    for solids in groups_of(world.obstacles):
        tensors += [solids.vertices, solids.planes, solids.faces]
    for tensor in tensors:
        yield repr(tuple(tensor.shape))
        yield tensor.numpy().tobytes()


def load_arrays(kind: str, key: str) -> dict[str, np.ndarray] | None:
    """Returns the arrays that are stored under a key. ``None`` if there are none, or the file is damaged."""
    try:
        data = memoryview(bytearray(zlib.decompress(_path(kind, key).read_bytes())))
        end = _SIZE.size + _SIZE.unpack_from(data)[0]
        described = json.loads(bytes(data[_SIZE.size : end]))
        arrays = {}
        for name, kind_of_number, shape in described:
            dtype, count, start = np.dtype(kind_of_number), math.prod(shape), _aligned(end)
            if dtype.kind == "b":
                bits = np.frombuffer(data, np.uint8, -(-count // 8), start)
                array, end = np.unpackbits(bits, count=count).view(bool), start + len(bits)
            else:
                array, end = np.frombuffer(data, dtype, count, start), start + count * dtype.itemsize
            arrays[name] = array.reshape(shape)
        return arrays
    except (OSError, ValueError, TypeError, struct.error, zlib.error):
        return None


def store_arrays(kind: str, key: str, arrays: dict[str, np.ndarray]) -> None:
    """Stores arrays of numbers under a key. Several processes may do so at once. A full disk is no error.

    A file is compressed with zlib, whose checksum covers all of it. It has the length of a description (4 bytes,
    little-endian), the description (JSON: name, type and shape of each array), and the arrays one after the other, each
    at a multiple of 8 bytes, those of booleans as bits. ``numpy.savez_compressed`` files take three times as long to
    read.
    """
    described = json.dumps([(name, array.dtype.str, array.shape) for name, array in arrays.items()]).encode()
    data = bytearray(_SIZE.pack(len(described)) + described)
    for array in arrays.values():
        data += bytes(_aligned(len(data)) - len(data))
        data += (np.packbits(array) if array.dtype.kind == "b" else array).tobytes()
    path = _path(kind, key)
    try:
        with written_whole(path) as temporary:
            temporary.write_bytes(zlib.compress(data, level=1))
        _delete_oldest(path)
    except OSError:
        pass


_SIZE = struct.Struct("<I")


def _delete_oldest(newest: Path) -> None:
    """Deletes the oldest files in the folder of the newest one while they take more than their share of the disk."""
    with os.scandir(newest.parent) as entries:
        files = sorted((entry.stat().st_mtime_ns, entry.stat().st_size, entry.path) for entry in entries)
    size = sum(size for _, size, _ in files)
    for _, freed, path in files:
        if size <= KEPT_BYTES / FOLDERS:
            return
        if path != str(newest):
            # Another process may have deleted it.
            Path(path).unlink(missing_ok=True)
            size -= freed


def _aligned(size: int) -> int:
    return -(-size // ALIGNMENT) * ALIGNMENT


def _path(kind: str, key: str) -> Path:
    return cache_folder() / kind / key[:2] / f"{key}.bin"
