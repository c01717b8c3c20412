"""Distributions of actions."""

from __future__ import annotations

from torch import Tensor
from torch.distributions import AffineTransform, ComposeTransform
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.continuous import SafeTanhTransform


class BoundedTanhNormal(TanhNormal):
    """Normal distribution that is squashed by tanh into bounds.

    Equals TorchRL's ``TanhNormal``, to the last bit, without its checks of the bounds. They read three values from the
    device for each distribution that is created, and the host would wait for a GPU each time.

    Args:
        loc: mean of the normal distribution, ``[..., n]``.
        scale: standard deviation of the normal distribution, ``[..., n]``.
        low: lower bounds, ``[n]``, on the device of ``loc``.
        high: upper bounds, ``[n]``, greater than the lower ones, on the device of ``loc``.
    """

    def __init__(self, loc: Tensor, scale: Tensor, low: Tensor, high: Tensor) -> None:
        # Does what the constructor of TanhNormal does after its checks.
        self.tanh_loc, self.upscale, self._event_dims = False, 5.0, min(1, loc.ndim)
        self.device, self.low, self.high = loc.device, low, high
        self._t = ComposeTransform([SafeTanhTransform(), AffineTransform((high + low) / 2, (high - low) / 2)])
        self.update(loc, scale)
