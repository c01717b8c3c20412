"""ONNX files of policies, as ONNX Runtime sees them."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

needs_onnx = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("onnxscript", "onnxruntime")), reason="needs rover_rl[onnx]"
)


def shapes(path: Path) -> tuple[dict[str, list[int]], ...]:
    """The shapes of the inputs and of the outputs, by name."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path))
    return tuple({one.name: one.shape for one in ends} for ends in (session.get_inputs(), session.get_outputs()))
