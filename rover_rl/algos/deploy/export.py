"""Export of the networks of trained policies to files that run without TorchRL: ONNX, or a ``torch.export`` program.

The exported policy maps raw observations, each float32 ``[1, n]`` by name, to the action ``[1, 2]`` without
exploration: forward speed (m/s) and heading offset (rad). A policy with memory also takes ``state_in``, zero at the
start of an episode, and returns ``state_out``, each float32 ``[1, s]``. Maps and tracks of what the lidar has seen are
no part of the file: a policy that reads ``route`` or ``movers`` takes them as inputs.

An ONNX file has the SHA-256 of its bytes as the property ``rover_rl_sha256``, computed with 64 zeros in its place. It
is verified when :class:`OnnxPolicy` loads the file.

Example:
    >>> export(load_pretrained("moon-ppo"), Path("moon.onnx"))
    >>> OnnxPolicy(Path("moon.onnx"))(RoverEnv(world="moon").reset())["action"].shape
    torch.Size([1, 2])
"""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Callable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.config_files import config_from, plain
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.grid_actions import grid_actions
from rover_rl.algos.policy.networks import action_spec, bounds_by_robot
from rover_rl.algos.policy.recurrent import PlainRecurrent
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.envs.sensors.robot import robot_table
from rover_rl.envs.sensors.suite import ROBOT, policy_sensors
from rover_rl.files import MADE_BY, written_whole
from rover_rl.robots import get_robot

Format: TypeAlias = Literal["onnx", "torch"]
ExportedFunction: TypeAlias = Callable[[Mapping[str, Any]], Any]
"""Function from inputs by name to an action ``[1, 2]``; with memory, to the action and ``state_out``."""

SUFFIXES: dict[str, str] = {"onnx": ".onnx", "torch": ".pt2"}  # file suffix of each format
STATE_IN, STATE_OUT = "state_in", "state_out"  # names of the state of a memory, before and after a decision
TOLERANCE = 1e-4  # largest accepted difference of an action, m/s or rad
CHECKED = 1000  # number of random observations on which an exported policy is compared with the original
_STATE = "memory"  # entry of a tensordict that holds the state of a policy from a file, float32 [N, s]
_SETTINGS, _CHECKSUM = "rover_rl", "rover_rl_sha256"
"""Properties of an ONNX file that hold the settings, as JSON, and its checksum."""
_ZEROS = b"0" * 64
_BEFORE_CHECKSUM = _CHECKSUM.encode() + b"\x12\x40"
"""What comes before the checksum in the bytes of an ONNX file: name of the property, tag and length of the value."""


class PlainPolicy(nn.Module):
    """A checkpoint's policy as a module from tensors of observations, named ``inputs``, to a tensor of actions.

    A policy that reads ``robot`` is told that of its settings. ``state_size`` is that of its memory.
    """

    robot: Tensor
    _low: Tensor
    _high: Tensor

    def __init__(self, checkpoint: Checkpoint) -> None:
        super().__init__()
        actor, network = checkpoint.make_actor(), checkpoint.config.network
        self._observation, self._on_grid = tuple(network.observation), network.distribution == "grid"
        self._network = PlainRecurrent(actor[0]) if network.memory != "none" else actor[0].module
        self.state_size: int = getattr(self._network, "state_size", 0)
        self.inputs = [*([STATE_IN] if self.state_size else []), *(key for key in self._observation if key != ROBOT)]
        self.outputs = ["action", *([STATE_OUT] if self.state_size else [])]
        space = action_spec(checkpoint.env.bounded_action).space
        low, high = space.low, space.high
        if ROBOT in self._observation:
            self.register_buffer("robot", robot_table([get_robot(checkpoint.env.robot)]))
            if by_robot := bounds_by_robot(checkpoint.config):
                low, high = by_robot(self.robot[0])
        self.register_buffer("_low", low)
        self.register_buffer("_high", high)

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Returns the action ``[N, 2]``, with a memory also the next state ``[N, s]``, for the inputs ``[N, n]``."""
        entries = dict(zip(self.inputs, inputs, strict=True))
        if ROBOT in self._observation:
            entries[ROBOT] = self.robot.expand(len(inputs[0]), -1)
        observation = [entries[key] for key in self._observation]
        if self.state_size:
            loc, state = self._network(entries[STATE_IN], *observation)
        else:
            loc, _ = self._network(*observation)
        low, high = self._low, self._high
        if self._on_grid:
            action = grid_actions(low, high)[loc.argmax(-1)]
        else:
            action = (high + low) / 2 + (high - low) / 2 * torch.tanh(loc)
        return (action, state) if self.state_size else action


def export(checkpoint: Checkpoint, path: Path, form: Format = "onnx") -> float:
    """Exports a policy, and returns the largest difference of an action on 1,000 random observations.

    To a policy with memory, they are the observations of one episode. Raises ``ImportError`` if a package that the
    format needs is not installed, and ``RuntimeError``, without a file, if actions differ by more than ``TOLERANCE``.
    """
    policy = PlainPolicy(checkpoint).eval()
    settings = json.dumps(plain(checkpoint.config))
    example = {STATE_IN: torch.zeros(1, policy.state_size), **random_observations(checkpoint, 1)}
    with torch.no_grad():
        program = torch.export.export(policy, tuple(example[key] for key in policy.inputs))
    with written_whole(path) as temporary:
        if form == "onnx":
            _write_onnx(program, policy, settings, temporary)
            exported: ExportedFunction = OnnxPolicy(temporary).act
        else:
            # Written to memory first: on a full disk, PyTorch's writer aborts the process.
            written = io.BytesIO()
            torch.export.save(program, written, extra_files={"rover_rl.json": settings})
            temporary.write_bytes(written.getvalue())
            module = torch.export.load(temporary).module()
            exported = lambda inputs: module(*(inputs[name] for name in policy.inputs))  # noqa: E731
        difference = _action_difference(checkpoint, exported, policy)
        if not difference <= TOLERANCE:
            raise RuntimeError(f"the exported policy acts otherwise: its actions differ by up to {difference:.2g}")
    return difference


def random_observations(checkpoint: Checkpoint, count: int) -> dict[str, Tensor]:
    """Draws inputs ``[count, n]`` of a policy, except its state, uniformly within their bounds, with seed 0."""
    generator = torch.Generator().manual_seed(0)
    sensors = policy_sensors(checkpoint.env.lidar, checkpoint.env.own_sensors)
    drawn = {}
    for key in checkpoint.config.network.observation:
        if key != ROBOT:
            low, high = sensors[key].bounds.tensors(None)
            drawn[key] = low + (high - low) * torch.rand(count, len(low), generator=generator)
    return drawn


def _action_difference(checkpoint: Checkpoint, exported: ExportedFunction, policy: PlainPolicy) -> float:
    rows = TensorDict(random_observations(checkpoint, CHECKED)).auto_batch_size_(1)
    runner, differences = PolicyRunner(checkpoint.make_actor(), action_repeat=1), []
    state, robot = torch.zeros(1, policy.state_size), {ROBOT: policy.robot} if hasattr(policy, ROBOT) else {}
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for row in rows.split(1):
            action = exported({**row, STATE_IN: state})
            if policy.state_size:
                action, state = action
            differences.append((action - runner(row.update(robot))).abs().max())
    return float(torch.stack(differences).max())


def _write_onnx(program: torch.export.ExportedProgram, policy: PlainPolicy, settings: str, path: Path) -> None:
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
    written.model.metadata_props.update({_SETTINGS: settings, _CHECKSUM: _ZEROS.decode(), **MADE_BY})
    written.save(str(path), external_data=False)
    content = path.read_bytes()
    checksum = sha256(content).hexdigest().encode()
    path.write_bytes(content.replace(_BEFORE_CHECKSUM + _ZEROS, _BEFORE_CHECKSUM + checksum, 1))


def _open_onnx(path: Path) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError('ONNX policies need the package onnxruntime: pip install "rover_rl[onnx]"') from error
    if not path.is_file():
        raise FileNotFoundError(f"no ONNX policy at {path}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    content = path.read_bytes()
    begin, mark, end = content.partition(_BEFORE_CHECKSUM)
    if not mark:
        raise ValueError(f"{path} is damaged, or was not written by rover-rl export: it has no checksum")
    if sha256(begin + mark + _ZEROS + end[len(_ZEROS) :]).hexdigest().encode() != end[: len(_ZEROS)]:
        raise ValueError(f"{path} is damaged: it differs from its checksum")
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ValueError(f"{path} is no ONNX policy: {' '.join(str(error).split())}") from error


class OnnxPolicy:
    """Policy from an ONNX file that :func:`export` wrote, for :func:`~rover_rl.algos.evaluation.evaluate.evaluate`.

    Each row takes a call of its own. ``config`` has the settings that the policy was trained with. Raises
    ``FileNotFoundError`` if there is no such file, ``ImportError`` if ``onnxruntime`` is not installed, and
    ``ValueError`` if the file is no exported policy, or damaged; in a call, for NaN or infinity in an observation.
    """

    row_by_row = True

    def __init__(self, path: Path) -> None:
        self._path, self._session = path, _open_onnx(path)
        self.config = config_from(json.loads(self._session.get_modelmeta().custom_metadata_map[_SETTINGS]), str(path))
        self.made_for, self.trained_action_repeat = self.config.env, self.config.collection.action_repeat
        sizes: dict[str, int] = {entry.name: entry.shape[-1] for entry in self._session.get_inputs()}
        self._names, self._state_size = [*sizes], sizes.pop(STATE_IN, 0)
        self._entries = [*sizes]
        self.in_keys: list[NestedKey] = [*self._entries, *([_STATE, "is_init"] if self._state_size else [])]
        self.out_keys: list[NestedKey] = ["action", *([("next", _STATE)] if self._state_size else [])]

    def __reduce__(self) -> tuple[type[OnnxPolicy], tuple[Path]]:
        # Sessions of onnxruntime cannot be pickled: other processes read the file again.
        return type(self), (self._path,)

    def act(self, inputs: Mapping[str, Any]) -> Any:
        """Returns the action ``[1, 2]`` for the inputs of a row by name; with memory, the action and ``state_out``."""
        arrays = {name: np.asarray(inputs[name], np.float32) for name in self._names}
        for name, array in arrays.items():
            if not np.isfinite(array).all():  # which networks accept
                raise ValueError(f"observation {name!r} holds NaN or infinity: the policy does not act on it")
        action, *state = map(torch.from_numpy, self._session.run(None, arrays))
        return (action, *state) if state else action

    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        rows = now.select(*self._entries).split(1)
        if not self._state_size:
            return now.set("action", torch.cat([self.act(dict(row)) for row in rows]))
        state = torch.where(now["is_init"], 0.0, now.get(_STATE, torch.zeros(len(now), self._state_size)))
        results = [self.act({**row, STATE_IN: part}) for row, part in zip(rows, state.split(1), strict=True)]
        actions, states = (torch.cat(parts) for parts in zip(*results, strict=True))
        return now.set("action", actions).set(("next", _STATE), states)
