"""Trained policies for machines without TorchRL: as ONNX, or as a program of ``torch.export``.

The exported policy takes raw observations, each ``[1, n]`` float32 by its name, scales them itself, and gives the
action ``[1, 2]`` that the policy takes without exploration: forward speed (m/s) and heading offset (rad).

Example:
    >>> export(load_pretrained("maze-ppo"), Path("maze.onnx"))
    >>> OnnxPolicy(Path("maze.onnx"))(env.reset())["action"]
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.config import config_from, plain
from rover_rl.algos.files import written_whole
from rover_rl.algos.policy import action_spec, middle_and_half
from rover_rl.algos.runs import Checkpoint
from rover_rl.envs.specs import observation_bounds

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

Format: TypeAlias = Literal["onnx", "torch"]

SUFFIXES: dict[str, str] = {"onnx": ".onnx", "torch": ".pt2"}
"""How files of each format are called."""
CHECKED = 1000
"""Observations on which an exported policy is held against the original."""
_PROPERTY = "rover_rl"
"""Name of the settings in an ONNX file."""
TOLERANCE = 1e-4
"""Largest difference of an action, m/s or rad."""


class PlainPolicy(nn.Module):
    """A checkpoint's policy as a function of tensors alone: observations in, action out."""

    _middle: Tensor
    _half: Tensor

    def __init__(self, checkpoint: Checkpoint) -> None:
        super().__init__()
        actor = checkpoint.make_actor()
        self.keys = checkpoint.config.observation
        self._network = actor[0].module
        middle, half = middle_and_half(action_spec(checkpoint.config.reverse))
        self.register_buffer("_middle", middle)
        self.register_buffer("_half", half)

    def forward(self, *observation: Tensor) -> Tensor:
        """The action ``[N, 2]`` for observations ``[N, n]``, in the order of ``keys``."""
        loc, _ = self._network(*observation)
        return self._middle + self._half * torch.tanh(loc)


def export(checkpoint: Checkpoint, path: Path, form: Format = "onnx") -> float:
    """Writes a policy, and holds it against the original on 1,000 observations.

    Returns:
        The largest difference of an action.

    Raises:
        ImportError: if what the format needs is not installed.
        RuntimeError: if the exported policy acts otherwise; nothing is written then.
    """
    policy = PlainPolicy(checkpoint).eval()
    observations = random_observations(checkpoint, CHECKED)
    with written_whole(path) as temporary:
        if form == "onnx":
            _write_onnx(policy, checkpoint, temporary)
            exported = onnx_function(temporary)
        else:
            _write_program(policy, checkpoint, temporary)
            exported = program_function(temporary)
        difference = _difference(checkpoint, exported, observations)
        if not difference <= TOLERANCE:
            raise RuntimeError(f"the exported policy acts otherwise: by {difference:.2g} at most")
    return difference


def random_observations(checkpoint: Checkpoint, count: int) -> dict[str, Tensor]:
    """Observations ``[count, n]`` of each entry that the policy reads, from all over its bounds, drawn by seed 0."""
    generator = torch.Generator().manual_seed(0)
    bounds = observation_bounds(checkpoint.lidar_points, 12.0)
    drawn = {}
    for key in checkpoint.config.observation:
        low, high = (torch.as_tensor(side).float() for side in (bounds[key].low, bounds[key].high))
        width = checkpoint.lidar_points if key == "lidar" else len(low)
        drawn[key] = low + (high - low) * torch.rand(count, width, generator=generator)
    return drawn


def _difference(
    checkpoint: Checkpoint, exported: Callable[[dict[str, Any]], Tensor], observations: dict[str, Tensor]
) -> float:
    """The largest difference between what the checkpoint's policy does and what the exported one does."""
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = checkpoint.make_actor()(TensorDict(observations, batch_size=[CHECKED]))["action"]
    actions = torch.cat([exported({k: v[row : row + 1] for k, v in observations.items()}) for row in range(CHECKED)])
    return (actions - expected).abs().max().item()


def _example(policy: PlainPolicy, checkpoint: Checkpoint) -> tuple[Tensor, ...]:
    observation = random_observations(checkpoint, 1)
    return tuple(observation[key] for key in policy.keys)


def _write_onnx(policy: PlainPolicy, checkpoint: Checkpoint, path: Path) -> None:
    try:
        import onnxscript  # noqa: F401  (torch.onnx needs it)
    except ImportError as error:
        raise ImportError('export to ONNX needs the packages of the extra: pip install "rover_rl[onnx]"') from error
    # It tells of every operator of packages that are not installed.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    program = torch.onnx.export(
        policy,
        _example(policy, checkpoint),
        input_names=list(policy.keys),
        output_names=["action"],
        dynamo=True,
        verbose=False,
    )
    assert program is not None
    program.model.metadata_props[_PROPERTY] = json.dumps(plain(checkpoint.config))
    program.save(str(path), external_data=False)


def _write_program(policy: PlainPolicy, checkpoint: Checkpoint, path: Path) -> None:
    program = torch.export.export(policy, _example(policy, checkpoint))
    torch.export.save(program, str(path), extra_files={"rover_rl.json": json.dumps(plain(checkpoint.config))})


def onnx_function(path: Path) -> Callable[[dict[str, Any]], Tensor]:
    """An ONNX file as a function from observations by name to an action ``[1, 2]``, on one thread.

    Raises:
        ImportError: if ``onnxruntime`` is not installed.
        ValueError: if the file is no such policy.
    """
    return _function(_session(path))


def _session(path: Path) -> InferenceSession:
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError('ONNX policies need the package onnxruntime: pip install "rover_rl[onnx]"') from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise ValueError(f"{path} is no ONNX policy: {error}") from error


def _function(session: InferenceSession) -> Callable[[dict[str, Any]], Tensor]:
    keys = [entry.name for entry in session.get_inputs()]

    def act(observation: dict[str, Any]) -> Tensor:
        (action,) = session.run(["action"], {key: np.asarray(observation[key], np.float32) for key in keys})
        return torch.from_numpy(action)

    return act


def program_function(path: Path) -> Callable[[dict[str, Any]], Tensor]:
    """A program of ``torch.export`` as a function from observations by name to an action ``[1, 2]``."""
    extra = {"rover_rl.json": ""}
    program = torch.export.load(str(path), extra_files=extra)
    keys, module = json.loads(extra["rover_rl.json"])["observation"], program.module()

    def act(observation: dict[str, Any]) -> Tensor:
        with torch.no_grad():
            return module(*(observation[key] for key in keys))

    return act


class OnnxPolicy:
    """An ONNX file as a policy that :func:`~rover_rl.algos.evaluate.evaluate` and ``rover-rl drive`` drive with.

    Args:
        path: of a file that :func:`export` wrote.

    Attributes:
        config: that the policy was trained with.
        lidar_points: readings that it sees.

    Raises:
        FileNotFoundError: if there is no such file.
        ImportError: if ``onnxruntime`` is not installed.
        ValueError: if the file is something else.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"no ONNX policy at {path}")
        session = _session(path)
        written = session.get_modelmeta().custom_metadata_map.get(_PROPERTY)
        if written is None:
            raise ValueError(f"{path} was not written by rover-rl export")
        self.config = config_from(json.loads(written), str(path))
        self.lidar_points = next((entry.shape[1] for entry in session.get_inputs() if entry.name == "lidar"), 32)
        self._act = _function(session)

    def __call__(self, now: TensorDictBase) -> TensorDictBase:
        """Sets ``"action"``, float32 ``[N, 2]``, row by row: the file is for one rover."""
        rows = [{key: now[key][row : row + 1] for key in self.config.observation} for row in range(len(now))]
        return now.set("action", torch.cat([self._act(row) for row in rows]))
