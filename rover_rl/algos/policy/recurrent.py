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
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.autograd.function import Function, once_differentiable
from torch.nn.functional import linear
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


class PlainRecurrent(nn.Module):
    """A :func:`recurrent_network` as a function of plain tensors, for export and training.

    A state ``[N, state_size]`` is the hidden one, for an LSTM followed by the cell.
    """

    def __init__(self, network: TensorDictSequential) -> None:
        super().__init__()
        embedding, recurrent, outputs = network
        self._embedding, self._head = embedding.module, outputs.module
        self._is_gru = isinstance(recurrent, GRUModule)
        self._cell = recurrent.gru if self._is_gru else recurrent.lstm
        self.state_size = self._cell.hidden_size * (1 if self._is_gru else 2)

    def forward(self, state: Tensor, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean of the action and the state after one step."""
        embedded = self._embedding(*observation)
        weights = self._cell.all_weights[0]
        if self._is_gru:
            hidden = following = torch.gru_cell(embedded, state, *weights)
        else:
            hidden, cell = torch.lstm_cell(embedded, state.chunk(2, -1), *weights)
            following = torch.cat((hidden, cell), -1)
        return self._head(embedded, hidden)[0], following

    def sequence(self, features: Tensor, is_init: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns mean and standard deviation ``[N, T, n]`` of actions, and the state after a sequence.

        ``features [N, T, F]`` are those of the observations. Where ``is_init [N, T, 1]``, the state counts as zeros.
        """
        embedded, going_on = self._embedding.body(features.transpose(0, 1)), (~is_init).transpose(0, 1).to(state.dtype)
        weight, *weights = self._cell.all_weights[0]
        if self._is_gru:
            hidden = UnrolledGRU.apply(linear(embedded, weight, weights[1]), going_on, state, weights[0], weights[2])
            state = hidden[-1]
        else:
            steps = []
            for step, kept in zip(embedded, going_on, strict=True):
                steps.append(torch.lstm_cell(step, (kept * state).chunk(2, -1), weight, *weights))
                state = torch.cat(steps[-1], -1)
            hidden = torch.stack([step[0] for step in steps])
        loc, scale = self._head(embedded, hidden)
        return loc.transpose(0, 1), scale.transpose(0, 1), state


class UnrolledGRU(Function):
    """Hidden states ``[T, N, H]`` of a GRU, with a backward pass that takes the gradient of the weights at once.

    It reads the products of the inputs, ``gates [T, N, 3 H]``, ``going_on [T, N, 1]``, which is 0 where an episode
    begins and else 1, the state before, ``[N, H]``, and the weights of the state.
    """

    @staticmethod
    def forward(ctx: Any, gates: Tensor, going_on: Tensor, state: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        size, steps, hidden = state.shape[-1], [], []
        for gate, kept in zip(gates, going_on, strict=True):
            before = state * kept
            recurrent = torch.addmm(bias, before, weight.t())
            reset_update = (gate[:, : 2 * size] + recurrent[:, : 2 * size]).sigmoid_()
            reset, update = reset_update.chunk(2, -1)
            recalled = recurrent[:, 2 * size :]
            new = torch.addcmul(gate[:, 2 * size :], reset, recalled).tanh_()
            state = torch.lerp(new, before, update)
            hidden.append(state)
            steps.append((before, reset_update, recalled, new))
        ctx.steps, ctx.going_on, ctx.weight = steps, going_on, weight
        return torch.stack(hidden)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grads: Tensor) -> tuple[Tensor | None, ...]:
        grad_gates, grad_recurrent = [], []
        grad = torch.zeros_like(grads[0])
        for step, kept, grad_step in zip(ctx.steps[::-1], ctx.going_on.flip(0), grads.flip(0), strict=True):
            before, reset_update, recalled, new = step
            reset, update = reset_update.chunk(2, -1)
            grad = grad + grad_step
            by_new = grad * (1 - update) * (1 - new * new)
            by_gates = torch.cat((by_new * recalled, grad * (before - new)), -1) * reset_update * (1 - reset_update)
            grad_gates.append(torch.cat((by_gates, by_new), -1))
            grad_recurrent.append(torch.cat((by_gates, by_new * reset), -1))
            grad = torch.addmm(grad * update, grad_recurrent[-1], ctx.weight) * kept
        by_recurrent, before = torch.cat(grad_recurrent), torch.cat([step[0] for step in ctx.steps[::-1]])
        by_gates = torch.stack(grad_gates[::-1])
        return by_gates, None, None, by_recurrent.t() @ before, by_recurrent.sum(0)


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
