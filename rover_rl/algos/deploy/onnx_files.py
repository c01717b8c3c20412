"""ONNX files: writing and opening, with a checksum."""

from __future__ import annotations

import logging
import re
import warnings
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.export import ExportedProgram

from rover_rl.algos.deploy.plain_policy import STATE_IN, STATE_OUT, ExportedFunction, finite_arrays

if TYPE_CHECKING:
    from typing import Any

    from onnxruntime import InferenceSession

SETTINGS_PROPERTY = "rover_rl"
"""Property of an ONNX file that holds the settings, as JSON."""
_CHECKSUM = "rover_rl_sha256"
"""Property of an ONNX file that holds its checksum."""
_ZEROS = "0" * 64
_CHECKSUM_BYTES = re.compile(_CHECKSUM.encode() + rb"\x12\x40([0-9a-f]{64})")
"""Checksum in the bytes of an ONNX file: name of the property, tag and length of the value, value."""


def write_onnx(program: ExportedProgram, inputs: list[str], outputs: list[str], settings: str, path: Path) -> None:
    """Writes a program to an ONNX file.

    Args:
        program: program to write.
        inputs: names of its inputs.
        outputs: names of its outputs.
        settings: settings of the policy, as JSON.
        path: path of the file.

    Raises:
        ImportError: if ``onnxscript`` is not installed.
    """
    try:
        import onnxscript  # noqa: F401  (torch.onnx needs it)
    except ImportError as error:
        raise ImportError('export to ONNX needs the extra onnx: pip install "rover_rl[onnx]"') from error
    # It logs a message for each operator of packages that are not installed.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        # PyTorch warns about its own code.
        warnings.simplefilter("ignore", FutureWarning)
        written = torch.onnx.export(program, input_names=inputs, output_names=outputs, dynamo=True, verbose=False)
    assert written is not None
    written.model.metadata_props.update({SETTINGS_PROPERTY: settings, _CHECKSUM: _ZEROS})
    written.save(str(path), external_data=False)
    content = path.read_bytes()
    place = _CHECKSUM_BYTES.search(content)
    assert place is not None
    path.write_bytes(_with_checksum(content, place, sha256(content).hexdigest()))


def _with_checksum(content: bytes, place: re.Match[bytes], checksum: str) -> bytes:
    return content[: place.start(1)] + checksum.encode() + content[place.end(1) :]


def open_onnx(path: Path) -> InferenceSession:
    """Opens an ONNX file in ONNX Runtime, on one thread.

    Raises:
        ImportError: if ``onnxruntime`` is not installed.
        ValueError: if the file is no ONNX file, or damaged.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError('ONNX policies need the package onnxruntime: pip install "rover_rl[onnx]"') from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    content = path.read_bytes()
    place = _CHECKSUM_BYTES.search(content)
    if place is None:
        raise ValueError(f"{path} is damaged, or was not written by rover-rl export: it has no checksum")
    if sha256(_with_checksum(content, place, _ZEROS)).hexdigest().encode() != place[1]:
        raise ValueError(f"{path} is damaged: it differs from its checksum")
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ValueError(f"{path} is no ONNX policy: {' '.join(str(error).split())}") from error


def session_function(session: InferenceSession) -> ExportedFunction:
    """Returns an opened ONNX policy as a function."""
    names = [entry.name for entry in session.get_inputs()]
    outputs = ["action", STATE_OUT] if STATE_IN in names else ["action"]

    def act(inputs: dict[str, Any]) -> Tensor | tuple[Tensor, ...]:
        results = session.run(outputs, dict(zip(names, finite_arrays(inputs, names), strict=True)))
        action, *state = map(torch.from_numpy, results)
        return (action, *state) if state else action

    return act
