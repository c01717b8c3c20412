"""Export of trained policies to files that run without TorchRL: ONNX, or a ``torch.export`` program.

The exported policy maps raw observations, each float32 ``[1, n]`` by name, to the action ``[1, 2]`` without
exploration: forward speed (m/s) and heading offset (rad). It includes the scaling of the observations.

A policy with memory also takes ``state_in`` and returns ``state_out``, each float32 ``[1, s]``. The state is zero at
the start of an episode, and ``state_out`` of a decision is ``state_in`` of the next one. A policy that reads ``route``
has a state, too: the file includes the map of what the lidar has seen and the planner, and reads ``lidar``, ``pose``,
``imu``, ``target`` and ``bounds`` in place of ``route``.

Both kinds of files contain checksums, which are verified when the files are loaded here. An ONNX file has the SHA-256
of its bytes as the property ``rover_rl_sha256``, computed with 64 zeros in its place. A program has a checksum for each
record.

Example:
    >>> export(load_pretrained("moon-ppo"), Path("moon.onnx"))
    >>> OnnxPolicy(Path("moon.onnx"))(RoverEnv(world="moon").reset())["action"].shape
    torch.Size([1, 2])
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any, Literal, TypeAlias

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torch.export import ExportedProgram
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.archives import checked_copy
from rover_rl.algos.config_files import config_from, plain
from rover_rl.algos.deploy.onnx_files import SETTINGS_PROPERTY, open_onnx, session_function, write_onnx
from rover_rl.algos.deploy.plain_policy import STATE_IN, ExportedFunction, PlainPolicy, finite_arrays, input_names
from rover_rl.algos.deploy.trial_inputs import drive_observations, random_observations
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.envs.seen_map.seen_map import BOUNDS
from rover_rl.files import written_whole

Format: TypeAlias = Literal["onnx", "torch"]

SUFFIXES: dict[str, str] = {"onnx": ".onnx", "torch": ".pt2"}
"""File suffix of each format."""
CHECKED = 1000
"""Number of observations on which an exported policy is compared with the original."""
CHECKED_DRIVE, CHECKED_JUMPS = 100, 20
"""Number of decisions of a drive, and of random observations after it, on which a policy with a map is compared."""
TOLERANCE = 1e-4
"""Largest accepted difference of an action, m/s or rad."""
EQUAL_SHARE = 0.99
"""Share of the decisions of a policy with a map that must be within the tolerance.

Sines and cosines of other libraries may differ in the last bit. If a beam ends that close to the edge of a cell,
another cell is marked, and the route may differ for a while."""
_STATE = "memory"
"""Entry of a tensordict that holds the state of a policy from a file, float32 ``[N, s]``."""


def export(checkpoint: Checkpoint, path: Path, form: Format = "onnx") -> float:
    """Exports a policy and compares its actions with those of the original on 1,000 observations.

    To a policy with memory, they are the observations of one episode. A policy that reads ``route`` is compared over a
    drive of 100 decisions among random walls, and on 20 random observations.

    Args:
        checkpoint: checkpoint of the policy.
        path: path of the file to write.
        form: file format, ``"onnx"`` or ``"torch"``.

    Returns:
        Largest difference of an action. For a policy that reads ``route``: the largest in 99 % of the decisions.

    Raises:
        ImportError: if a package that the format needs is not installed.
        RuntimeError: if the actions differ by more than ``TOLERANCE``. No file is written then.
        ValueError: if the policy reads ``route``, and the lidar is mounted too far from the robot's center.
    """
    policy = PlainPolicy(checkpoint).eval()
    settings = json.dumps(plain(checkpoint.config))
    with torch.no_grad():
        program = torch.export.export(policy, _example(policy, checkpoint))
    with written_whole(path) as temporary:
        if form == "onnx":
            write_onnx(program, policy.inputs, policy.outputs, settings, temporary)
            exported = onnx_function(temporary)
        else:
            _write_program(program, settings, temporary)
            exported = program_function(temporary)
        difference = _difference(checkpoint, exported, policy)
        if not difference <= TOLERANCE:
            raise RuntimeError(f"the exported policy acts otherwise: its actions differ by up to {difference:.2g}")
    return difference


def _difference(checkpoint: Checkpoint, exported: ExportedFunction, policy: PlainPolicy) -> float:
    """Returns the largest difference between the actions of the checkpoint's policy and the exported one.

    For a policy with a map, it is the largest in a share of the decisions: see ``EQUAL_SHARE``.
    """
    if BOUNDS not in policy.inputs:
        return float(_differences(checkpoint, exported, policy, random_observations(checkpoint, CHECKED)).max())
    drive, jumps = drive_observations(checkpoint, CHECKED_DRIVE), random_observations(checkpoint, CHECKED_JUMPS)
    observations = {key: torch.cat((drive[key], jumps[key])) for key in drive}
    differences = _differences(checkpoint, exported, policy, observations)
    return float(differences.quantile(EQUAL_SHARE, interpolation="lower"))


def _differences(
    checkpoint: Checkpoint, exported: ExportedFunction, policy: PlainPolicy, observations: dict[str, Tensor]
) -> Tensor:
    """Returns the difference of the actions in each decision of an episode; NaN if an action is."""
    rows = TensorDict(observations).auto_batch_size_(1).split(1)
    runner, state = PolicyRunner(checkpoint.make_actor(), action_repeat=1), torch.zeros(1, policy.state_size)
    differences = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for row in rows:
            action = exported({**row, STATE_IN: state})
            if policy.state_size:
                action, state = action
            differences.append((action - runner(row)).abs().max())
    return torch.stack(differences)


def _example(policy: PlainPolicy, checkpoint: Checkpoint) -> tuple[Tensor, ...]:
    example = {STATE_IN: torch.zeros(1, policy.state_size), **random_observations(checkpoint, 1)}
    return tuple(example[key] for key in policy.inputs)


def _write_program(program: ExportedProgram, settings: str, path: Path) -> None:
    # Written to memory first: on a full disk, PyTorch's writer aborts the process.
    written = io.BytesIO()
    torch.export.save(program, written, extra_files={"rover_rl.json": settings})
    path.write_bytes(written.getvalue())


def onnx_function(path: Path) -> ExportedFunction:
    """Loads an ONNX file as a function, on one thread.

    Raises:
        ImportError: if ``onnxruntime`` is not installed.
        ValueError: if the file is no ONNX policy, or damaged. The function raises it for NaN or infinity in an
            observation.
    """
    return session_function(open_onnx(path))


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

    names = input_names(network)

    def act(inputs: dict[str, Any]) -> Tensor | tuple[Tensor, ...]:
        with torch.no_grad():
            return module(*map(torch.from_numpy, finite_arrays(inputs, names)))

    return act


class OnnxPolicy:
    """Policy from an ONNX file, for :func:`~rover_rl.algos.evaluation.evaluate.evaluate`.

    Args:
        path: path of a file that :func:`export` wrote.

    Attributes:
        config: settings that the policy was trained with.
        made_for: environment that the policy was made for.
        trained_action_repeat: number of steps that each action was held for in training.
        row_by_row: whether each row takes a call of its own: always.
        in_keys: entries that the policy reads. With a map or a memory, its state is one of them.
        out_keys: entries that the policy writes.

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
        session = open_onnx(path)
        try:
            settings = json.loads(session.get_modelmeta().custom_metadata_map.get(SETTINGS_PROPERTY, "null"))
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
        self._act = session_function(session)

    def __reduce__(self) -> tuple[type[OnnxPolicy], tuple[Path]]:
        # Sessions of onnxruntime cannot be pickled: other processes read the file again.
        return type(self), (self._path,)

    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        """Sets ``"action"``, float32 ``[N, 2]``, and the next state.

        Computes them row by row, because the file has a batch size of 1.
        """
        rows = now.select(*self._entries).split(1)
        if self._state_size is None:
            return now.set("action", torch.cat([self._act(dict(row)) for row in rows]))
        state = now.get(_STATE, torch.zeros(len(now), self._state_size))
        state = torch.where(now["is_init"], 0.0, state)
        results = [self._act({**row, STATE_IN: part}) for row, part in zip(rows, state.split(1), strict=True)]
        actions, states = (torch.cat(parts) for parts in zip(*results, strict=True))
        return now.set("action", actions).set(("next", _STATE), states)
