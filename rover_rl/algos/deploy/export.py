"""Export of trained policies to files that run without TorchRL: ONNX, or a ``torch.export`` program.

The exported policy maps raw observations, each float32 ``[1, n]`` by name, to the action ``[1, 2]`` without
exploration: forward speed (m/s) and heading offset (rad). A policy with memory, or with a map of what the lidar has
seen, also takes ``state_in``, zero at the start of an episode, and returns ``state_out``, each float32 ``[1, s]``.

Both kinds of files contain checksums, which are verified when the files are loaded here. An ONNX file has the SHA-256
of its bytes as the property ``rover_rl_sha256``, computed with 64 zeros in its place.

Example:
    >>> export(load_pretrained("moon-ppo"), Path("moon.onnx"))
    >>> OnnxPolicy(Path("moon.onnx"))(RoverEnv(world="moon").reset())["action"].shape
    torch.Size([1, 2])
"""

from __future__ import annotations

import io
import json
import logging
import re
import warnings
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torch.export import ExportedProgram

from rover_rl.algos.archives import checked_copy
from rover_rl.algos.config_files import config_from, plain
from rover_rl.algos.deploy.comparison import action_difference, random_observations
from rover_rl.algos.deploy.plain_policy import (
    STATE_IN,
    STATE_OUT,
    ExportedFunction,
    PlainPolicy,
    finite_arrays,
    input_names,
)
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.files import MADE_BY, written_whole

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

Format: TypeAlias = Literal["onnx", "torch"]

SUFFIXES: dict[str, str] = {"onnx": ".onnx", "torch": ".pt2"}  # file suffix of each format
TOLERANCE = 1e-4  # largest accepted difference of an action, m/s or rad
_STATE = "memory"  # entry of a tensordict that holds the state of a policy from a file, float32 [N, s]
_SETTINGS, _CHECKSUM = "rover_rl", "rover_rl_sha256"
"""Properties of an ONNX file that hold the settings, as JSON, and its checksum."""
_ZEROS = "0" * 64
_CHECKSUM_BYTES = re.compile(_CHECKSUM.encode() + rb"\x12\x40([0-9a-f]{64})")
"""Checksum in the bytes of an ONNX file: name of the property, tag and length of the value, value."""


def export(checkpoint: Checkpoint, path: Path, form: Format = "onnx") -> float:
    """Exports a policy and compares its actions with those of the original on 1,000 observations.

    To a policy with memory, they are the observations of one episode. A policy that reads ``route`` is compared over a
    drive of 100 decisions among random walls, and on 20 random observations.

    Returns:
        Largest difference of an action. For a policy that reads ``route``: the largest in 99 % of the decisions.

    Raises:
        ImportError: if a package that the format needs is not installed.
        RuntimeError: if the actions differ by more than ``TOLERANCE``. No file is written then.
        ValueError: if the policy reads ``route``, and the lidar is mounted too far from the robot's center.
    """
    policy = PlainPolicy(checkpoint).eval()
    settings = json.dumps(plain(checkpoint.config))
    example = {STATE_IN: torch.zeros(1, policy.state_size), **random_observations(checkpoint, 1)}
    with torch.no_grad():
        program = torch.export.export(policy, tuple(example[key] for key in policy.inputs))
    with written_whole(path) as temporary:
        if form == "onnx":
            _write_onnx(program, policy, settings, temporary)
            exported = onnx_function(temporary)
        else:
            _write_program(program, settings, temporary)
            exported = program_function(temporary)
        difference = action_difference(checkpoint, exported, policy)
        if not difference <= TOLERANCE:
            raise RuntimeError(f"the exported policy acts otherwise: its actions differ by up to {difference:.2g}")
    return difference


def _write_program(program: ExportedProgram, settings: str, path: Path) -> None:
    # Written to memory first: on a full disk, PyTorch's writer aborts the process.
    written = io.BytesIO()
    torch.export.save(program, written, extra_files={"rover_rl.json": settings})
    path.write_bytes(written.getvalue())


def program_function(path: Path) -> ExportedFunction:
    """Loads a ``torch.export`` program as a function. Raises ``ValueError`` if it is none, or damaged."""
    content, extra = path.read_bytes(), {"rover_rl.json": ""}
    try:
        program = torch.export.load(checked_copy(content), extra_files=extra)
        network, module = config_from(json.loads(extra["rover_rl.json"]), str(path)).network, program.module()
    except Exception as error:  # a damaged file can fail in any way
        raise ValueError(f"{path} is damaged, or was not written by rover-rl export") from error

    names = input_names(network)

    def act(inputs: dict[str, Any]) -> Tensor | tuple[Tensor, ...]:
        with torch.no_grad():
            return module(*map(torch.from_numpy, finite_arrays(inputs, names)))

    return act


def _write_onnx(program: ExportedProgram, policy: PlainPolicy, settings: str, path: Path) -> None:
    try:
        import onnxscript  # noqa: F401  (torch.onnx needs it)
    except ImportError as error:
        raise ImportError('export to ONNX needs the extra onnx: pip install "rover_rl[onnx]"') from error
    # They log a message for each operator of packages that are not installed, or that is not folded.
    for logger in ("torch.onnx", "onnxscript"):
        logging.getLogger(logger).setLevel(logging.ERROR)
    names: dict[str, Any] = {"input_names": policy.inputs, "output_names": policy.outputs}
    with warnings.catch_warnings():
        # PyTorch warns about its own code.
        warnings.simplefilter("ignore", FutureWarning)
        written = torch.onnx.export(program, **names, dynamo=True, verbose=False)
    assert written is not None
    written.model.metadata_props.update({_SETTINGS: settings, _CHECKSUM: _ZEROS, **MADE_BY})
    written.save(str(path), external_data=False)
    content = path.read_bytes()
    place = _CHECKSUM_BYTES.search(content)
    assert place is not None
    path.write_bytes(_with_checksum(content, place, sha256(content).hexdigest()))


def _with_checksum(content: bytes, place: re.Match[bytes], checksum: str) -> bytes:
    return content[: place.start(1)] + checksum.encode() + content[place.end(1) :]


def _open_onnx(path: Path) -> InferenceSession:
    """Opens an ONNX file in ONNX Runtime, on one thread, after verifying its checksum."""
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


def _session_function(session: InferenceSession) -> ExportedFunction:
    names = [entry.name for entry in session.get_inputs()]
    outputs = ["action", STATE_OUT] if STATE_IN in names else ["action"]

    def act(inputs: dict[str, Any]) -> Tensor | tuple[Tensor, ...]:
        results = session.run(outputs, dict(zip(names, finite_arrays(inputs, names), strict=True)))
        action, *state = map(torch.from_numpy, results)
        return (action, *state) if state else action

    return act


def onnx_function(path: Path) -> ExportedFunction:
    """Loads an ONNX file as a function, on one thread. Raises ``ValueError`` if it is no policy, or damaged."""
    return _session_function(_open_onnx(path))


class OnnxPolicy:
    """Policy from an ONNX file that :func:`export` wrote, for :func:`~rover_rl.algos.evaluation.evaluate.evaluate`.

    Each row takes a call of its own. With a map or a memory, the policy reads and writes its state.

    Attributes:
        config: settings that the policy was trained with.
        made_for: environment that the policy was made for.
        trained_action_repeat: number of steps that each action was held for in training.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if ``onnxruntime`` is not installed.
        ValueError: if the file is no exported policy, or damaged. Calling the policy raises it for NaN or infinity in
            an observation.
    """

    row_by_row = True

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"no ONNX policy at {path}")
        self._path = path
        session = _open_onnx(path)
        try:
            settings = json.loads(session.get_modelmeta().custom_metadata_map.get(_SETTINGS, "null"))
        except ValueError as error:  # invalid encoding or JSON
            raise ValueError(f"{path} is damaged: its settings cannot be read") from error
        if settings is None:
            raise ValueError(f"{path} was not written by rover-rl export")
        self.config = config_from(settings, str(path))
        sizes: dict[str, int] = {entry.name: entry.shape[-1] for entry in session.get_inputs()}
        self.made_for, self.trained_action_repeat = self.config.env, self.config.collection.action_repeat
        self._state_size = sizes.pop(STATE_IN, None)
        self._entries = [*sizes]
        self.in_keys: list[NestedKey] = [*self._entries]
        self.out_keys: list[NestedKey] = ["action"]
        if self._state_size is not None:
            self.in_keys += [_STATE, "is_init"]
            self.out_keys += [("next", _STATE)]
        self._act = _session_function(session)

    def __reduce__(self) -> tuple[type[OnnxPolicy], tuple[Path]]:
        # Sessions of onnxruntime cannot be pickled: other processes read the file again.
        return type(self), (self._path,)

    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        """Sets ``"action"``, float32 ``[N, 2]``, and the next state, row by row: the file has a batch size of 1."""
        rows = now.select(*self._entries).split(1)
        if self._state_size is None:
            return now.set("action", torch.cat([self._act(dict(row)) for row in rows]))
        state = now.get(_STATE, torch.zeros(len(now), self._state_size))
        state = torch.where(now["is_init"], 0.0, state)
        results = [self._act({**row, STATE_IN: part}) for row, part in zip(rows, state.split(1), strict=True)]
        actions, states = (torch.cat(parts) for parts in zip(*results, strict=True))
        return now.set("action", actions).set(("next", _STATE), states)
