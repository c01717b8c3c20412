"""Actors with memory: TorchRL's GRU between the layers of the observation and the head.

The memory travels in the tensordict, in the way of TorchRL: an actor reads its state at :data:`MEMORY` and writes the
next state at the same key under ``"next"``. Where ``is_init`` is set, the state counts as zeros. A training
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
from torchrl.modules import GRUModule

MEMORY = "memory_hidden"
"""Entry of a tensordict that holds the state of a memory, float32 ``[N, 1, units]``."""


def recurrent_network(embedding: TensorDictModule, units: int, head: nn.Module, size: int) -> nn.Module:
    """Combines a module that writes ``embedding [..., units]``, a memory of ``size`` units and a head into one module.

    The head also reads the embedding: reactions to what the rover sees need not pass through the memory.
    """
    recurrent = GRU(units, size, in_keys=["embedding", MEMORY, "is_init"], out_keys=["recalled", ("next", MEMORY)])
    for name, parameter in recurrent.named_parameters():
        (nn.init.orthogonal_ if "weight" in name else nn.init.zeros_)(parameter)
    outputs = TensorDictModule(_Joined(head), in_keys=["embedding", "recalled"], out_keys=["loc", "scale"])
    # Collectors store all outputs: the embedding and what is recalled would take more memory than the observation.
    return TensorDictSequential(embedding, recurrent, outputs, selected_out_keys=["loc", "scale", ("next", MEMORY)])


class GRU(GRUModule):
    """TorchRL's GRU, with steps that do not ask whether an episode begins: the host would wait for a GPU."""

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes output and next state of a step, or in recurrent mode those of sequences."""
        if self.recurrent_mode:
            return super().forward(tensordict)
        value, state, is_init = (tensordict.get(key) for key in self.in_keys)
        shape, count = value.shape[:-1], value.shape[:-1].numel()
        if state is None:
            state = value.new_zeros(*shape, 1, self.gru.hidden_size)
        state = torch.where(is_init[..., None], 0, state).reshape(count, -1)
        out = torch.gru_cell(value.reshape(count, -1), state, *self.gru.all_weights[0]).reshape(*shape, -1)
        return tensordict.set(self.out_keys[0], out).set(self.out_keys[1], out.unsqueeze(-2))


class _Joined(nn.Module):
    def __init__(self, module: nn.Module) -> None:
        super().__init__()
        self.module = module

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        return self.module(torch.cat(inputs, -1))


class PlainRecurrent(nn.Module):
    """A :func:`recurrent_network` as a function of plain tensors, for export and training.

    A state is ``[N, state_size]``.
    """

    def __init__(self, network: TensorDictSequential) -> None:
        super().__init__()
        embedding, recurrent, outputs = network
        self._embedding, self._head = embedding.module, outputs.module
        self._cell = recurrent.gru
        self.state_size: int = self._cell.hidden_size

    def forward(self, state: Tensor, *observation: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the mean of the action and the state after one step."""
        embedded = self._embedding(*observation)
        state = torch.gru_cell(embedded, state, *self._cell.all_weights[0])
        return self._head(embedded, state)[0], state

    def sequence(self, features: Tensor, is_init: Tensor, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Returns mean and standard deviation ``[T N, n]`` of actions, and the state after a sequence.

        ``features [T N, F]`` are those of the observations of ``N`` rovers, one step after another. Where
        ``is_init [T N, 1]``, the state, ``[N, s]`` before the sequence, counts as zeros.
        """
        embedded, going_on = self._embedding.body(features), 1 - is_init.to(state.dtype)
        by_input, by_state, input_bias, state_bias = self._cell.all_weights[0]
        gates, going_on = (
            each.unflatten(0, (-1, len(state))) for each in (linear(embedded, by_input, input_bias), going_on)
        )
        hidden = UnrolledGRU.apply(gates, going_on, state, by_state, state_bias)
        return *self._head(embedded, hidden.flatten(0, 1)), hidden[-1]


class UnrolledGRU(Function):
    """Hidden states ``[T, N, H]`` of a GRU, with a backward pass whose steps are few operations.

    It reads the products of the inputs, ``gates [T, N, 3 H]``, ``going_on [T, N, 1]``, which is 0 where an episode
    begins and else 1, the state before, ``[N, H]``, and the weights of the state.
    """

    @staticmethod
    def forward(ctx: Any, gates: Tensor, going_on: Tensor, state: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        size, transposed = state.shape[-1], weight.t()
        recurrent, reset_update = torch.empty_like(gates), gates.new_empty(*gates.shape[:2], 2 * size)
        before, new, hidden = gates.new_empty(3, *gates.shape[:2], size)
        inner, inputs = (each.split([2 * size, size], -1) for each in (recurrent, gates))
        reset, update = reset_update.chunk(2, -1)
        steps = (going_on, recurrent, before, new, hidden, *inner, *inputs, reset_update, reset, update)
        for kept, products, start, candidate, after, *parts in zip(*(each.unbind() for each in steps), strict=True):
            by_state, recalled, by_input, seen, both, reset, update = parts
            torch.mul(state, kept, out=start)
            torch.addmm(bias, start, transposed, out=products)
            torch.add(by_input, by_state, out=both).sigmoid_()
            torch.addcmul(seen, reset, recalled, out=candidate).tanh_()
            state = torch.lerp(candidate, start, update, out=after)
        ctx.save_for_backward(going_on, weight, inner[1], before, reset_update, new)
        return hidden

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grads: Tensor) -> tuple[Tensor | None, ...]:
        going_on, weight, recalled, before, reset_update, new = ctx.saved_tensors
        reset, update = reset_update.chunk(2, -1)
        # Derivatives of a hidden state by its gates, which all steps take at once.
        by_new = (1 - update) * (1 - new.square())
        by_gates = torch.cat((by_new * recalled, before - new), -1) * (reset_update * (1 - reset_update))
        slopes = torch.cat((by_gates, by_new * reset), -1).unflatten(-1, (3, -1))
        by_recurrent, totals, grad = torch.empty_like(slopes), torch.empty_like(grads), torch.zeros_like(grads[0])
        steps = (each.unbind() for each in (grads, going_on, update, slopes, by_recurrent, totals))
        for grad_step, kept, passed, slope, found, total in [*zip(*steps, strict=True)][::-1]:
            torch.add(grad, grad_step, out=total)
            torch.mul(total.unsqueeze(1), slope, out=found)
            grad = torch.addmm(total * passed, found.flatten(1), weight).mul_(kept)
        by_input = torch.cat((by_recurrent[:, :, :2].flatten(2), totals * by_new), -1)
        flat = by_recurrent.flatten(2).flatten(0, 1)
        return by_input, None, None, flat.t() @ before.flatten(0, 1), flat.sum(0)


def memory_transforms(kind: str, size: int) -> list[Transform]:
    """Returns the transforms that an environment needs in which an actor with memory collects data.

    They add ``is_init`` and the state of the memory, of ``size`` units, which is zero at the start of each episode.
    Without them, TorchRL raises no error, and the state stays zero.
    """
    if kind == "none":
        return []
    return [InitTracker(), MemoryPrimer({MEMORY: Unbounded(shape=(1, size))}, expand_specs=True)]


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
