"""Loss of PPO on plain tensors, with the formulas of TorchRL's ``ClipPPOLoss`` for squashed normal distributions."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import softplus

_LARGEST = 1 - 1e-6  # largest share of the range of an action that is unsquashed, as in TorchRL


def squashing(action: Tensor, low: Tensor, high: Tensor) -> dict[str, Tensor]:
    """Returns how actions ``[..., n]`` within bounds were made of values ``[..., n]``, for :func:`ppo_losses`.

    ``unsquashed`` are the values, ``log_half [...]`` is that of half of the range, summed, and ``log_slope [...]`` that
    of the derivative of the action.
    """
    half = (high - low) / 2
    value = ((action - (high + low) / 2) / half).clamp(-_LARGEST, _LARGEST).atanh()
    log_half = half.log().sum(-1).expand(value.shape[:-1])
    return {"unsquashed": value, "log_half": log_half, "log_slope": log_half + _log_slope(value)}


def _log_slope(value: Tensor) -> Tensor:
    return 2 * (math.log(2) - value - softplus(-2 * value)).sum(-1)


def ppo_losses(
    loc: Tensor, scale: Tensor, value: Tensor, rows: Mapping[str, Tensor], noise: Tensor, clip: float
) -> dict[str, Tensor]:
    """Returns the terms of PPO's loss, and what is logged, each a mean over decisions ``[...]``.

    Args:
        loc, scale: mean and standard deviation of an action before squashing, ``[..., n]``.
        value: estimated value, ``[..., 1]``.
        rows: ``action_log_prob`` and ``advantage [...]``, ``value_target [..., 1]``, and those of :func:`squashing`.
        noise: standard normal numbers ``[..., n]``, by which the entropy is estimated.
        clip: clipping range of the probability ratio.
    """
    log_scale = scale.log().sum(-1) + 0.5 * math.log(2 * math.pi) * scale.shape[-1]
    log_prob = -0.5 * ((rows["unsquashed"] - loc) / scale).square().sum(-1) - log_scale - rows["log_slope"]
    log_ratio = log_prob - rows["action_log_prob"]
    clipped = log_ratio.clamp(math.log1p(-clip), math.log1p(clip))
    gain = torch.minimum(log_ratio.exp() * rows["advantage"], clipped.exp() * rows["advantage"])
    sample_log_prob = -0.5 * noise.square().sum(-1) - log_scale - rows["log_half"] - _log_slope(loc + scale * noise)
    return {
        "loss_objective": -gain.mean(),
        "loss_imitation": -log_prob.mean(),
        "loss_critic": 0.5 * (value - rows["value_target"]).square().mean(),
        "entropy": -sample_log_prob.mean(),
        "kl_approx": -log_ratio.detach().mean(),
        "clip_fraction": (clipped != log_ratio).to(loc.dtype).mean(),
    }
