"""Export of trained policies to files that run without TorchRL: ONNX, or a ``torch.export`` program.

The exported policy maps raw observations, each float32 ``[1, n]`` by name, to the action ``[1, 2]`` without
exploration: forward speed (m/s) and heading offset (rad). It includes the scaling of the observations.

A policy with memory also takes ``state_in`` and returns ``state_out``, each float32 ``[1, s]``. The state is zero at
the start of an episode, and ``state_out`` of a decision is ``state_in`` of the next one.

Both kinds of files contain checksums, which are verified when the files are loaded here. An ONNX file has the SHA-256
of its bytes as the property ``rover_rl_sha256``, computed with 64 zeros in its place. A program has a checksum for each
record.

Example:
    >>> export(load_pretrained("maze-ppo"), Path("maze.onnx"))
    >>> OnnxPolicy(Path("maze.onnx"))(env.reset())["action"]
"""

from __future__ import annotations

import io
import json
import logging
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.archives import checked_copy
from rover_rl.algos.config import with_settings
from rover_rl.algos.config_files import config_from, plain
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import action_spec, middle_and_half
from rover_rl.algos.policy.recurrent import RecurrentStep
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.envs.observation import observation_bounds
from rover_rl.files import written_whole

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

Format: TypeAlias = Literal["onnx", "torch"]

SUFFIXES: dict[str, str] = {"onnx": ".onnx", "torch": ".pt2"}
"""File suffix of each format."""
CHECKED = 1000
"""Number of observations on which an exported policy is compared with the original."""
_PROPERTY = "rover_rl"
"""Property of an ONNX file that holds the settings, as JSON."""
_CHECKSUM = "rover_rl_sha256"
"""Property of an ONNX file that holds its checksum."""
STATE_IN, STATE_OUT = "state_in", "state_out"
"""Names of the state of the memory, before and after a decision."""
ExportedFunction: TypeAlias = Callable[[dict[str, Any]], Any]
"""Exported policy: function from observations by name to an action ``[1, 2]``. With memory, the observations include
``state_in``, and the function returns the action and ``state_out``."""
_STATE = "memory"
"""Entry of a tensordict that holds the state of the memory of a policy from a file, float32 ``[N, s]``."""
_ZEROS = "0" * 64
_CHECKSUM_BYTES = re.compile(_CHECKSUM.encode() + rb"\x12\x40([0-9a-f]{64})")
"""Checksum in the bytes of an ONNX file: name of the property, tag and length of the value, value."""
TOLERANCE = 1e-4
"""Largest accepted difference of an action, m/s or rad."""


class PlainPolicy(nn.Module):
    """A checkpoint's policy as a module that maps tensors of observations to a tensor of actions.

    Args:
        checkpoint: checkpoint of the policy.

    Attributes:
        inputs: names of the arguments, in their order.
        outputs: names of the results, in their order.
        state_size: number of entries of the state of the memory; 0 without memory.
    """

    _middle: Tensor
    _half: Tensor

    def __init__(self, checkpoint: Checkpoint) -> None:
        super().__init__()
        actor, memory = checkpoint.make_actor(), checkpoint.config.network.memory != "none"
        self._network = RecurrentStep(actor[0]) if memory else actor[0].module
        self.state_size: int = self._network.state_size if memory else 0
        self.inputs = [*([STATE_IN] if memory else []), *checkpoint.config.network.observation]
        self.outputs = ["action", *([STATE_OUT] if memory else [])]
        middle, half = middle_and_half(action_spec(checkpoint.env.action))
        self.register_buffer("_middle", middle)
        self.register_buffer("_half", half)

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Returns the action ``[N, 2]``, with memory also the next state ``[N, s]``, for the inputs ``[N, n]``."""
        loc, second = self._network(*inputs)
        action = self._middle + self._half * torch.tanh(loc)
        return (action, second) if self.state_size else action


def export(checkpoint: Checkpoint, path: Path, form: Format = "onnx") -> float:
    """Exports a policy and compares its actions with those of the original on 1,000 observations.

    To a policy with memory, they are the observations of one episode.

    Args:
        checkpoint: checkpoint of the policy.
        path: path of the file to write.
        form: file format, ``"onnx"`` or ``"torch"``.

    Returns:
        Largest difference of an action.

    Raises:
        ImportError: if a package that the format needs is not installed.
        RuntimeError: if the actions differ by more than ``TOLERANCE``. No file is written then.
    """
    policy = PlainPolicy(checkpoint).eval()
    with written_whole(path) as temporary:
        if form == "onnx":
            _write_onnx(policy, checkpoint, temporary)
            exported = onnx_function(temporary)
        else:
            _write_program(policy, checkpoint, temporary)
            exported = program_function(temporary)
        difference = _difference(checkpoint, exported, policy.state_size)
        if not difference <= TOLERANCE:
            raise RuntimeError(f"the exported policy acts otherwise: its actions differ by up to {difference:.2g}")
    return difference


def random_observations(checkpoint: Checkpoint, count: int) -> dict[str, Tensor]:
    """Draws observations ``[count, n]`` of each key that the policy reads, uniformly within its bounds, with seed 0."""
    generator = torch.Generator().manual_seed(0)
    bounds = observation_bounds(checkpoint.env.lidar)
    drawn = {}
    for key in checkpoint.config.network.observation:
        low, high = (torch.as_tensor(side).float() for side in (bounds[key].low, bounds[key].high))
        width = checkpoint.lidar_points if key == "lidar" else len(low)
        drawn[key] = low + (high - low) * torch.rand(count, width, generator=generator)
    return drawn


def _difference(checkpoint: Checkpoint, exported: ExportedFunction, state_size: int) -> float:
    """Returns the largest difference between the actions of the checkpoint's policy and the exported one."""
    observations = random_observations(checkpoint, CHECKED)
    rows = TensorDict(observations, batch_size=[CHECKED]).split(1)
    runner, state = PolicyRunner(checkpoint.make_actor(), action_repeat=1), torch.zeros(1, state_size)
    differences = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for row in rows:
            action = exported({**row, STATE_IN: state})
            if state_size:
                action, state = action
            differences.append((action - runner(row)).abs().max().item())
    # Unlike Python's, PyTorch's maximum is NaN if a difference is.
    return torch.tensor(differences).max().item()


def _example(policy: PlainPolicy, checkpoint: Checkpoint) -> tuple[Tensor, ...]:
    example = {STATE_IN: torch.zeros(1, policy.state_size), **random_observations(checkpoint, 1)}
    return tuple(example[key] for key in policy.inputs)


def _write_onnx(policy: PlainPolicy, checkpoint: Checkpoint, path: Path) -> None:
    try:
        import onnxscript  # noqa: F401  (torch.onnx needs it)
    except ImportError as error:
        raise ImportError('export to ONNX needs the extra onnx: pip install "rover_rl[onnx]"') from error
    # It logs a message for each operator of packages that are not installed.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        # PyTorch warns about its own code.
        warnings.simplefilter("ignore", FutureWarning)
        program = torch.onnx.export(
            policy,
            _example(policy, checkpoint),
            input_names=policy.inputs,
            output_names=policy.outputs,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    program.model.metadata_props.update({_PROPERTY: json.dumps(plain(checkpoint.config)), _CHECKSUM: _ZEROS})
    program.save(str(path), external_data=False)
    content = path.read_bytes()
    place = _CHECKSUM_BYTES.search(content)
    assert place is not None
    path.write_bytes(_with_checksum(content, place, sha256(content).hexdigest()))


def _with_checksum(content: bytes, place: re.Match[bytes], checksum: str) -> bytes:
    return content[: place.start(1)] + checksum.encode() + content[place.end(1) :]


def _write_program(policy: PlainPolicy, checkpoint: Checkpoint, path: Path) -> None:
    program = torch.export.export(policy, _example(policy, checkpoint))
    # Written to memory first: on a full disk, PyTorch's writer aborts the process.
    written = io.BytesIO()
    torch.export.save(program, written, extra_files={"rover_rl.json": json.dumps(plain(checkpoint.config))})
    path.write_bytes(written.getvalue())


def onnx_function(path: Path) -> ExportedFunction:
    """Loads an ONNX file as a function, on one thread.

    Raises:
        ImportError: if ``onnxruntime`` is not installed.
        ValueError: if the file is no ONNX policy, or damaged. The function raises it for NaN or infinity in an
            observation.
    """
    return _function(_session(path))


def _session(path: Path) -> InferenceSession:
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError('ONNX policies need the package onnxruntime: pip install "rover_rl[onnx]"') from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    content = path.read_bytes()
    place = _CHECKSUM_BYTES.search(content)
    # Files of older versions have no checksum.
    if place and sha256(_with_checksum(content, place, _ZEROS)).hexdigest().encode() != place[1]:
        raise ValueError(f"{path} is damaged: it differs from its checksum")
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ValueError(f"{path} is no ONNX policy: {' '.join(str(error).split())}") from error


def _function(session: InferenceSession) -> ExportedFunction:
    keys = [entry.name for entry in session.get_inputs()]
    outputs = ["action", STATE_OUT] if STATE_IN in keys else ["action"]

    def act(observation: dict[str, Any]) -> Tensor | tuple[Tensor, ...]:
        results = session.run(outputs, dict(zip(keys, _finite(observation, keys), strict=True)))
        action, *state = map(torch.from_numpy, results)
        return (action, *state) if state else action

    return act


def _finite(observation: Mapping[str, Any], keys: Sequence[str]) -> list[NDArray[np.float32]]:
    """Returns the entries of an observation after checking that they are finite.

    Raises:
        ValueError: for the first entry with NaN or infinity, which a network would accept silently.
    """
    entries = [np.asarray(observation[key], np.float32) for key in keys]
    for key, entry in zip(keys, entries, strict=True):
        if not np.isfinite(entry).all():
            raise ValueError(f"observation {key!r} holds NaN or infinity: the policy does not act on it")
    return entries


def program_function(path: Path) -> ExportedFunction:
    """Loads a ``torch.export`` program as a function.

    Raises:
        ValueError: if the file is no such program, or damaged. The function raises it for NaN or infinity in an
            observation.
    """
    content, extra = path.read_bytes(), {"rover_rl.json": ""}
    try:
        program = torch.export.load(checked_copy(content), extra_files=extra)
        network, module = config_from(json.loads(extra["rover_rl.json"]), str(path)).network, program.module()
    except Exception as error:  # a damaged file can fail in any way
        raise ValueError(f"{path} is damaged, or was not written by rover-rl export") from error

    keys = [*([] if network.memory == "none" else [STATE_IN]), *network.observation]

    def act(observation: dict[str, Any]) -> Tensor | tuple[Tensor, ...]:
        with torch.no_grad():
            return module(*map(torch.from_numpy, _finite(observation, keys)))

    return act


class OnnxPolicy:
    """Policy from an ONNX file, for :func:`~rover_rl.algos.evaluation.evaluate.evaluate`.

    Args:
        path: path of a file that :func:`export` wrote.

    Attributes:
        config: settings that the policy was trained with.
        made_for: environment that the policy was made for.
        trained_action_repeat: number of steps that each action was held for in training.
        in_keys: entries that the policy reads. With a memory, its state is one of them.
        out_keys: entries that the policy writes.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if ``onnxruntime`` is not installed.
        ValueError: if the file is no exported policy, or damaged. Calling the policy raises it for NaN or infinity in
            an observation.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"no ONNX policy at {path}")
        self._path = path
        session = _session(path)
        try:
            settings = json.loads(session.get_modelmeta().custom_metadata_map.get(_PROPERTY, "null"))
        except ValueError as error:  # invalid encoding or JSON
            raise ValueError(f"{path} is damaged: its settings cannot be read") from error
        if settings is None:
            raise ValueError(f"{path} was not written by rover-rl export")
        self.config = config_from(settings, str(path))
        lidar = next((entry.shape[1] for entry in session.get_inputs() if entry.name == "lidar"), None)
        if lidar is not None and lidar != self.config.env.lidar.points:
            # The settings in files of version 0.1 lack the number of lidar points.
            self.config = with_settings(self.config, lidar=replace(self.config.env.lidar, points=lidar))
        self.made_for, self.trained_action_repeat = self.config.env, self.config.collection.action_repeat
        sizes = {entry.name: entry.shape[-1] for entry in session.get_inputs()}
        self._state_size: int | None = sizes.get(STATE_IN)
        self.in_keys: list[NestedKey] = [*self.config.network.observation]
        self.out_keys: list[NestedKey] = ["action"]
        if self._state_size is not None:
            self.in_keys += [_STATE, "is_init"]
            self.out_keys += [("next", _STATE)]
        self._act = _function(session)

    def __reduce__(self) -> tuple[type[OnnxPolicy], tuple[Path]]:
        # Sessions of onnxruntime cannot be pickled: other processes read the file again.
        return type(self), (self._path,)

    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        """Sets ``"action"``, float32 ``[N, 2]``, and the next state of the memory.

        Computes them row by row, because the file has a batch size of 1.
        """
        rows = now.select(*self.config.network.observation).split(1)
        if self._state_size is None:
            return now.set("action", torch.cat([self._act(dict(row)) for row in rows]))
        state = now.get(_STATE, torch.zeros(len(now), self._state_size))
        state = torch.where(now["is_init"], 0.0, state)
        results = [self._act({**row, STATE_IN: part}) for row, part in zip(rows, state.split(1), strict=True)]
        actions, states = (torch.cat(parts) for parts in zip(*results, strict=True))
        return now.set("action", actions).set(("next", _STATE), states)
