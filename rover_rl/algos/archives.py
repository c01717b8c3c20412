"""Archives: files of PyTorch tensors and plain data, with checksums. Reading a file executes no code in it."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_rl.files import write_through


def write_archive(path: Path, form: str, data: Mapping[str, Any]) -> None:
    # Written to memory first: the errors of PyTorch's writer do not say that a disk is full.
    written = io.BytesIO()
    torch.save({"format": form, **data}, written)
    # Released at once: the error of a full disk keeps this frame alive, and Python 3.12.1 crashes when its garbage
    # collector finds a view that is not released.
    with written.getbuffer() as view:
        write_through(path, view)


def read_archive(path: Path, form: str, kind: str) -> dict[str, Any]:
    """Reads a file that :func:`write_archive` wrote. No code in the file is executed."""
    if not path.is_file():
        raise FileNotFoundError(f"no {kind} at {path}")
    content = path.read_bytes()
    try:
        with warnings.catch_warnings():
            # PyTorch warns about foreign pickles before it fails.
            warnings.simplefilter("ignore")
            data = torch.load(checked_copy(content), map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can fail in any way
        raise ValueError(f"{path} is damaged, or no {kind} of rover_rl") from error
    if not isinstance(data, dict) or data.pop("format", None) != form:
        raise ValueError(f"{path} is no {kind} of this version of rover_rl")
    return data


def checked_copy(archive: bytes) -> io.BytesIO:
    """Copies an archive that PyTorch wrote and verifies the checksum of each record, which PyTorch does not do.

    The copy has new headers: for a record with a damaged header, PyTorch may return uninitialized memory.
    """
    copy = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as records, zipfile.ZipFile(copy, "w") as checked:
        for record in records.infolist():
            checked.writestr(record.filename, records.read(record))
    copy.seek(0)
    return copy


def first_not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Returns the name of the first tensor with NaN or infinity, ``None`` if all are finite."""
    if not tensors:
        return None
    # All tensors are checked at once, because each transfer to the CPU synchronizes with the GPU.
    finite = torch.stack([tensor.isfinite().all() for tensor in tensors.values()]).tolist()
    return next((name for name, whole in zip(tensors, finite, strict=True) if not whole), None)
