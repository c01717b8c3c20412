"""Files of PyTorch tensors and plain data, with checksums. Nothing in a file is executed."""

from __future__ import annotations

import io
import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_rl.files import write_through


def write_archive(path: Path, form: str, data: Mapping[str, Any]) -> None:
    """Writes plain data and tensors, with the format's name."""
    # In memory first: on a full disk, PyTorch's writer fails with errors that do not say so.
    written = io.BytesIO()
    torch.save({"format": form, **data}, written)
    write_through(path, written.getbuffer())


def read_archive(path: Path, forms: Sequence[str], kind: str) -> dict[str, Any]:
    """Reads what :func:`write_archive` wrote. Nothing in the file is executed.

    Args:
        path: the file.
        forms: names of the formats that are understood.
        kind: what the file is called in messages.

    Returns:
        The data, with the format's name as ``"format"``.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if the file is something else, or damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no {kind} at {path}")
    content = path.read_bytes()
    try:
        with warnings.catch_warnings():
            # PyTorch warns about a pickle of others before it fails.
            warnings.simplefilter("ignore")
            data = torch.load(checked_copy(content), map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can fail in any way
        raise ValueError(f"{path} is damaged, or no {kind} of rover_rl") from error
    if not isinstance(data, dict) or data.get("format") not in forms:
        raise ValueError(f"{path} is no {kind} of this version of rover_rl")
    return data


def checked_copy(archive: bytes) -> io.BytesIO:
    """A copy of a file that PyTorch wrote, each record compared with its checksum, which PyTorch does not do.

    The copy has new headers: for a record with a damaged header, PyTorch may return uninitialized memory.

    Raises:
        zipfile.BadZipFile: for a difference, or another kind of file; a damaged file may raise other errors, too.
    """
    copy = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as records, zipfile.ZipFile(copy, "w") as checked:
        for record in records.infolist():
            checked.writestr(record.filename, records.read(record))
    copy.seek(0)
    return copy


def first_not_finite(tensors: Mapping[str, Tensor]) -> str | None:
    """Name of the first tensor that holds NaN or infinity; ``None`` if all are finite."""
    if not tensors:
        return None
    # One check for all of them: each check waits for a GPU.
    finite = torch.stack([tensor.isfinite().all() for tensor in tensors.values()]).tolist()
    return next((name for name, whole in zip(tensors, finite, strict=True) if not whole), None)
