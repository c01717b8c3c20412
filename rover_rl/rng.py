"""Counter-based random numbers per row, without the state of a generator.

A random number is a function of row seed, episode, stream and draw, computed in int64. It does not depend on the
device, the batch size, the order of the draws or the other rows. The hash is the finalizer of SplitMix64 over a Weyl
sequence (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor


def _signed(value: int) -> int:
    return value - (1 << 64) if value >= 1 << 63 else value


_GOLDEN, _MIX_1, _MIX_2 = map(_signed, (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
_EPISODE, _STREAM, _DRAW = map(_signed, (0xD1342543DE82EF95, 0xDA942042E4DD58B5, 0xAEF17502108EF2D9))


def row_keys(seed: int, num_envs: int, device: torch.device) -> Tensor:
    """Returns the keys of rows with the seeds ``seed, seed + 1, ...``, int64 ``[N, 1]``."""
    first = _signed(seed % (1 << 64))
    return _mix(first + torch.arange(num_envs, dtype=torch.int64, device=device))[:, None]


def episode_keys(rows: Tensor, episode: Tensor | int) -> Tensor:
    """Returns the keys of episodes, int64 ``[N, 1]``, of rows by their keys, and their numbers, ``[N, 1]`` or one."""
    return _mix(rows + episode * _EPISODE)


def random_bits(keys: Tensor, stream: int, draw: Tensor | int, count: int) -> Tensor:
    """Returns ``count`` independent 64-bit hashes per row, int64 ``[N, count]``, from ``keys`` of episodes ``[N, 1]``.

    ``stream`` identifies the purpose, and ``draw`` is the index of the draw for it, ``[N, 1]`` or one for all rows.
    """
    offset = draw * _DRAW + _signed(stream * _STREAM % (1 << 64))
    if isinstance(offset, int):
        # Python's integers do not overflow as int64 tensors do.
        offset = _signed(offset % (1 << 64))
    return _mix(keys + offset + _lanes(count, keys.device))


@lru_cache(maxsize=64)
def _lanes(count: int, device: torch.device) -> Tensor:
    return torch.arange(1, count + 1, dtype=torch.int64, device=device) * _GOLDEN


def to_index(bits: Tensor, size: Tensor) -> Tensor:
    """Returns uniform integers in ``[0, size)`` from the upper 32 bits. ``size`` is int64 and less than 2^31."""
    return (_shift(bits, 32) * size) >> 32


def whole_between(bits: Tensor, ends: tuple[int, int]) -> Tensor:
    """Returns uniform integers from the first to the last of a range."""
    return ends[0] + to_index(bits, torch.full_like(bits, ends[1] - ends[0] + 1))


def between(bits: Tensor, ends: tuple[float, float]) -> Tensor:
    """Returns uniform numbers in a range, float32."""
    return ends[0] + (ends[1] - ends[0]) * to_unit(bits)


def to_unit(bits: Tensor) -> Tensor:
    """Returns uniform numbers in [0, 1) from the lower 24 bits, float32, in steps of 2^-24."""
    return (bits & 0xFFFFFF).to(torch.float32) * 2.0**-24


def to_normal(bits: Tensor) -> Tensor:
    """Returns standard normal numbers from the lower 48 bits, float32 (Box and Muller, 1958)."""
    radius = torch.sqrt(-2 * torch.log(1 - to_unit(bits)))
    return radius * torch.cos(2 * math.pi * to_unit(bits >> 24))


def _shift(bits: Tensor, places: int) -> Tensor:
    # PyTorch's >> keeps the sign, and does not fill with zeros.
    return (bits >> places) & ((1 << (64 - places)) - 1)


def _mix(x: Tensor) -> Tensor:
    """Finalizer of SplitMix64."""
    if x.device.type == "cpu":
        # The same in NumPy, which shifts unsigned integers and takes a fraction of the time for few rows.
        bits = x.numpy().view(np.uint64)
        bits = (bits ^ (bits >> 30)) * np.uint64(_MIX_1 % (1 << 64))
        bits = (bits ^ (bits >> 27)) * np.uint64(_MIX_2 % (1 << 64))
        return torch.from_numpy((bits ^ (bits >> 31)).view(np.int64))
    x = (x ^ _shift(x, 30)) * _MIX_1
    x = (x ^ _shift(x, 27)) * _MIX_2
    return x ^ _shift(x, 31)
