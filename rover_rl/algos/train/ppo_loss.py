"""Loss of PPO and its gradient, with the formulas of TorchRL's ``ClipPPOLoss`` for squashed normal distributions."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import softplus

LOSSES = ("loss_objective", "entropy", "kl_approx", "clip_fraction")
"""What :func:`ppo_losses` returns, in this order."""
_LARGEST = 1 - 1e-6  # largest share of the range of an action that is unsquashed, as in TorchRL


def squashing(action: Tensor, low: Tensor, high: Tensor) -> dict[str, Tensor]:
    """Returns how actions ``[..., n]`` within bounds were made of values ``[..., n]``, for :func:`ppo_losses`.

    ``unsquashed`` are the values, ``log_half [..., 1]`` is that of half of the range, summed, and ``log_slope
    [..., 1]`` that of the derivative of the action.
    """
    half = (high - low) / 2
    value = ((action - (high + low) / 2) / half).clamp(-_LARGEST, _LARGEST).atanh()
    log_half = half.log().sum(-1, keepdim=True).expand(*value.shape[:-1], 1)
    return {"unsquashed": value, "log_half": log_half, "log_slope": log_half + _log_slope(value).sum(-1, keepdim=True)}


def _log_slope(value: Tensor) -> Tensor:
    return 2 * (math.log(2) + torch.sub(value, softplus(value, beta=2), alpha=2))


@torch.no_grad()
def ppo_losses(
    loc: Tensor, scale: Tensor, rows: Mapping[str, Tensor], noise: Tensor, clip: float, terms: Mapping[str, float]
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Returns the :data:`LOSSES` of ``M`` decisions, means, and the gradient of a weighted sum of some of them.

    The gradient is that by ``loc`` and ``scale``. Written out, it takes a third of the operations of PyTorch's own.

    Args:
        loc, scale: mean and standard deviation of an action before squashing, ``[M, n]``.
        rows: ``action_log_prob`` and ``advantage``, ``[M, 1]``, and those of :func:`squashing`.
        noise: standard normal numbers ``[M, n]``, by which the entropy is estimated.
        clip: clipping range of the probability ratio.
        terms: weights of ``loss_objective``, ``entropy`` and ``loss_imitation``; without one, 0. ``loss_imitation``,
            the negative log-likelihood of the actions, takes the place of ``loss_objective``.
    """
    log_scale, z = scale.log() + 0.5 * math.log(2 * math.pi), (rows["unsquashed"] - loc) / scale
    log_prob = -torch.addcmul(log_scale, z, z, value=0.5).sum(-1, keepdim=True) - rows["log_slope"]
    log_ratio = log_prob - rows["action_log_prob"]
    ratio = log_ratio.exp()
    gain, bound = ratio * rows["advantage"], ratio.clamp(1 - clip, 1 + clip) * rows["advantage"]
    sampled = torch.addcmul(loc, scale, noise)
    entropy = torch.addcmul(log_scale + _log_slope(sampled), noise, noise, value=0.5).sum(-1, keepdim=True)
    imitates, share = "loss_imitation" in terms, 1 / len(loc)
    objective = -log_prob if imitates else -torch.minimum(gain, bound)
    found = torch.cat((objective, entropy + rows["log_half"], -log_ratio, gain != bound), -1)
    pull = torch.ones_like(gain) if imitates else torch.where(gain <= bound, gain, 0.0)
    by_log_prob = pull * (-share * terms.get("loss_imitation" if imitates else "loss_objective", 0.0))
    by_entropy, by_z = share * terms.get("entropy", 0.0), by_log_prob * z
    # The derivative of the logarithm of the derivative of tanh is -2 tanh.
    by_sampled = sampled.tanh() * (-2 * by_entropy)
    by_loc = torch.addcdiv(by_sampled, by_z, scale)
    by_scale = torch.addcdiv(by_sampled * noise, torch.addcmul(by_entropy - by_log_prob, by_z, z), scale)
    return found.mean(0), (by_loc, by_scale)


@torch.no_grad()
def grid_losses(
    logits: Tensor, scale: Tensor, rows: Mapping[str, Tensor], noise: Tensor, clip: float, terms: Mapping[str, float]
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """Does what :func:`ppo_losses` does, for a distribution over the actions of a grid.

    Args:
        logits, scale: parameters of a :class:`~rover_rl.algos.policy.grid_actions.GridDistribution`.
        rows: ``action_log_prob`` and ``advantage``, and the ``index`` of the action, ``[M, 1]``; for the imitation of
            an expert that weighs all actions also ``labels [M, K]``.
        noise: not used, as the entropy is exact.
        clip, terms: as for normal distributions.
    """
    log_probs, index, share = logits.log_softmax(-1), rows["index"].long(), 1 / len(logits)
    probs, chosen = log_probs.exp(), torch.zeros_like(log_probs).scatter_(-1, index, 1.0)
    log_ratio = log_probs.gather(-1, index) - rows["action_log_prob"]
    gain = log_ratio.exp() * rows["advantage"]
    bound = log_ratio.exp().clamp(1 - clip, 1 + clip) * rows["advantage"]
    entropy = -(probs * log_probs).sum(-1, keepdim=True)
    if "loss_imitation" in terms:
        weights = rows.get("labels", chosen)
        objective, pull = -(weights * log_probs).sum(-1, keepdim=True), weights * terms["loss_imitation"]
    else:
        objective = -torch.minimum(gain, bound)
        pull = chosen * torch.where(gain <= bound, gain, 0.0) * terms.get("loss_objective", 0.0)
    found = torch.cat((objective, entropy, -log_ratio, gain != bound), -1)
    # By the logits z, log p_i has the derivative 1 - p at i and -p elsewhere, and the entropy H -p (log p + H).
    by_objective = probs * pull.sum(-1, keepdim=True) - pull
    by_entropy = -probs * (log_probs + entropy) * terms.get("entropy", 0.0)
    return found.mean(0), (share * (by_objective + by_entropy), scale)
