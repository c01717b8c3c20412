"""Safe reading of NumPy files: nothing is unpickled, and each error is a sentence."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

Shape = tuple[int | None, ...]
"""Length of each dimension of an array; ``None`` for any length."""


def read_npz(path: Path, shapes: Mapping[str, Shape]) -> dict[str, np.ndarray]:
    """Reads arrays of numbers from an ``.npz`` file.

    Args:
        path: the file.
        shapes: shape of each array, by name. All first dimensions that are ``None`` are independent of one another.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, lacks an array, or an array has another shape or does not hold numbers.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}")
    try:
        with np.load(path, allow_pickle=False) as file:
            missing = [name for name in shapes if name not in file]
            if missing:
                raise KeyError(missing[0])
            arrays = {name: file[name] for name in shapes}
    except KeyError as error:
        raise ValueError(f"{path} has no array {error}; it needs {', '.join(shapes)}") from error
    except (ValueError, EOFError, zipfile.BadZipFile, OSError, TypeError, AttributeError) as error:
        raise ValueError(_unreadable(path)) from error
    return {name: _checked(f"{name} in {path}", arrays[name], shape) for name, shape in shapes.items()}


def read_npy(path: Path, shape: Shape) -> np.ndarray:
    """Reads an array of numbers from an ``.npy`` file.

    Args:
        path: the file.
        shape: shape of the array.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is damaged, or the array has another shape or does not hold numbers.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no file at {path}")
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile, OSError) as error:
        raise ValueError(_unreadable(path)) from error
    if not isinstance(array, np.ndarray):
        raise ValueError(_unreadable(path))
    return _checked(str(path), array, shape)


def _unreadable(path: Path) -> str:
    return f"{path} is damaged, no NumPy file, or has pickled objects, which are not read"


def _checked(what: str, array: np.ndarray, shape: Shape) -> np.ndarray:
    fits = array.ndim == len(shape) and all(n in (None, m) for n, m in zip(shape, array.shape, strict=True))
    if not fits or array.dtype.kind not in "biuf":
        expected = " x ".join("any" if n is None else str(n) for n in shape)
        raise ValueError(f"{what} must be numbers of the shape {expected}, got {array.dtype} {list(array.shape)}")
    return array
