"""Actors with memory: TorchRL's recurrent modules between the layers of the observation and the head.

The memory travels in the tensordict, in the way of TorchRL: an actor reads its state at :data:`MEMORY_KEYS` and writes
the next state at the same keys under ``"next"``. Where ``is_init`` is set, the state counts as zeros. A training
environment needs :func:`memory_transforms`. Everything else drives with a
:class:`~rover_rl.algos.policy.runner.PolicyRunner`.

Example:
    >>> actor = make_actor(memory="gru", memory_size=64)
    >>> [*actor.in_keys][-2:]
    ['memory_hidden', 'is_init']
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Unbounded
from torchrl.envs.transforms import InitTracker, TensorDictPrimer, Transform
from torchrl.modules import GRUModule, LSTMModule

MEMORY_KEYS: dict[str, tuple[str, ...]] = {
    "none": (),
    "gru": ("memory_hidden",),
    "lstm": ("memory_hidden", "memory_cell"),
}
"""Entries of a tensordict that hold the state of each kind of memory, float32 ``[N, 1, units]`` each."""


def recurrent_network(embedding: TensorDictModule, units: int, head: nn.Module, kind: str, size: int) -> nn.Module:
    """Combines a module that writes ``embedding [..., units]``, a memory of ``size`` units and a head into one module.

    The head also reads the embedding: reactions to what the rover sees need not pass through the memory.
    """
    state = MEMORY_KEYS[kind]
    recurrent = {"gru": GRU, "lstm": LSTMModule}[kind](
        units, size, in_keys=["embedding", *state, "is_init"], out_keys=["recalled", *(("next", key) for key in state)]
    )
    for name, parameter in recurrent.named_parameters():
        (nn.init.orthogonal_ if "weight" in name else nn.init.zeros_)(parameter)
    outputs = TensorDictModule(_Joined(head), in_keys=["embedding", "recalled"], out_keys=["loc", "scale"])
    # Collectors store all outputs: the embedding and what is recalled would take more memory than the observation.
    kept = ["loc", "scale", *(("next", key) for key in state)]
    return TensorDictSequential(embedding, recurrent, outputs, selected_out_keys=kept)


class GRU(GRUModule):
    """TorchRL's GRU, with steps that do not ask whether an episode begins: the host would wait for a GPU."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes output and next state of a step, or in recurrent mode those of sequences."""
        if self.recurrent_mode:
            return super().forward(tensordict)
        value, state, is_init = (tensordict.get(key) for key in self.in_keys)
        shape = value.shape[:-1]
        size = (shape.numel(), 1, -1)
        if state is None:
            state = value.new_zeros(*shape, 1, self.gru.hidden_size)
        state = torch.where(is_init[..., None], 0, state).reshape(size).transpose(0, 1).contiguous()
        out, state = self.gru(value.reshape(size), state)
        tensordict.set(self.out_keys[0], out.reshape(*shape, -1))
        return tensordict.set(self.out_keys[1], state.reshape(*shape, 1, -1))


class _Joined(nn.Module):
    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        return self.module(torch.cat(inputs, -1))


class RecurrentStep(nn.Module):
    """One step of a :func:`recurrent_network` as a function of plain tensors, with ``state_size``, for export."""

    def __init__(self, network: TensorDictSequential) -> None:
        super().__init__()
        embedding, recurrent, outputs = network
        self._embedding, self._head = embedding.module, outputs.module
        self._is_gru = isinstance(recurrent, GRUModule)
        self._cell = recurrent.gru if self._is_gru else recurrent.lstm
        self.state_size = self._cell.hidden_size * (1 if self._is_gru else 2)

    def forward(self, state: Tensor, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean of the action and the next state ``[N, state_size]``; for an LSTM, hidden, then cell."""
        embedded = self._embedding(*observation)
        weights = self._cell.all_weights[0]
        if self._is_gru:
            hidden = following = torch.gru_cell(embedded, state, *weights)
        else:
            hidden, cell = torch.lstm_cell(embedded, state.chunk(2, -1), *weights)
            following = torch.cat((hidden, cell), -1)
        return self._head(embedded, hidden)[0], following


def memory_transforms(kind: str, size: int) -> list[Transform]:
    """Returns the transforms that an environment needs in which an actor with memory collects data.

    They add ``is_init`` and the state of the memory, of ``size`` units, which is zero at the start of each episode.
    Without them, TorchRL raises no error, and the state stays zero.
    """
    if kind == "none":
        return []
    state = {key: Unbounded(shape=(1, size)) for key in MEMORY_KEYS[kind]}
    return [InitTracker(), MemoryPrimer(state, expand_specs=True)]


class MemoryPrimer(TensorDictPrimer):
    """TorchRL's ``TensorDictPrimer``, with resets of all rows: asking which ones would wait for a GPU."""

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for key, spec in self.primers.items(True, True):
            tensordict_reset.set(key, spec.zero())
        return tensordict_reset


def state_keys(policy: object) -> list[str]:
    """Returns the keys of a policy's state: those that it reads, and writes under ``"next"``; none without memory."""
    written: Sequence[object] = getattr(policy, "out_keys", ())
    return [key for key in getattr(policy, "in_keys", ()) if ("next", key) in written]
