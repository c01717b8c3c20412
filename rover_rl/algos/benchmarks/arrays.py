"""Safe reading of NumPy files: nothing is unpickled, and each error is a sentence."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

Shape = tuple[int | None, ...]  # length of each dimension of an array; None for any length


def read_npz(path: Path, shapes: Mapping[str, Shape]) -> dict[str, np.ndarray]:
    """Reads arrays of numbers with the given shapes, by name, from an ``.npz`` file."""
    arrays = _load(path)
    if isinstance(arrays, np.ndarray):
        raise ValueError(f"{path} must be an .npz file, with the arrays {', '.join(shapes)}")
    if missing := [name for name in shapes if name not in arrays]:
        raise ValueError(f"{path} has no array {missing[0]!r}; it needs {', '.join(shapes)}")
    return {name: _checked(f"{name} in {path}", arrays[name], shape) for name, shape in shapes.items()}


def read_npy(path: Path, shape: Shape) -> np.ndarray:
    """Reads an array of numbers with the given shape from an ``.npy`` file."""
    return _checked(str(path), _load(path), shape)


def _load(path: Path) -> Any:
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}")
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded:
            return dict(loaded)
    except (ValueError, EOFError, zipfile.BadZipFile, OSError, TypeError, AttributeError) as error:
        raise ValueError(f"{path} is damaged, no NumPy file, or has pickled objects, which are not read") from error


def _checked(what: str, array: Any, shape: Shape) -> np.ndarray:
    array = np.asarray(array)
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "biuf":
        expected = " x ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{what} must be numbers of the shape {expected}, got {array.dtype} {list(array.shape)}")
    return array
