"""Memory of an actor in updates on sequences."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import ProbabilisticActor, set_recurrent_mode

from rover_rl.algos.policy.networks import mirrored
from rover_rl.algos.policy.recurrent import state_keys
from rover_rl.envs.sensors.base import Sensor


class MirrorMemory:
    """Memory that an actor would have if it had seen the mirror image of everything.

    A sequence in a batch starts with the state that the actor had there. The mirror image of the sequence has another
    one: that of an actor that saw the mirror image from the start of the episode. This class computes it, batch by
    batch, with one more pass of the actor over each batch. As the states that the collector stores, it is that of the
    weights with which the batches were collected.

    Args:
        actor: actor, with or without memory.
        sensors: sensors of the observation, by key; ``None``: those of every rover.
    """

    def __init__(self, actor: ProbabilisticActor, sensors: Mapping[str, Sensor] | None = None) -> None:
        self._actor, self._keys, self._sensors = actor, state_keys(actor), sensors
        self._last: dict[str, Tensor] = {}

    @torch.no_grad()
    def starts(self, decisions: TensorDictBase) -> dict[str, Tensor]:
        """Returns the states ``[N, T, 1, units]`` of the mirror image of a batch, by key; empty without memory.

        Only the states at the start of a sequence or an episode are those of the mirror image. Updates read no others.

        Args:
            decisions: batch ``[N, T]`` that follows the last one.
        """
        if not self._keys:
            return {}
        states = {key: decisions[key].clone() for key in self._keys}
        is_init = decisions["is_init"][:, 0, :, None]
        for key, last in self._last.items():
            states[key][:, 0] = torch.where(is_init, 0.0, last)
        every = torch.ones(decisions.batch_size, dtype=torch.bool, device=decisions["is_init"].device)
        with set_recurrent_mode(True):
            image = self._actor[0](mirrored(decisions, every, self._sensors).update(states))
        self._last = {key: image["next", key][:, -1] for key in self._keys}
        return states


def mirrored_sequences(
    decisions: TensorDictBase, rows: Tensor, starts: dict[str, Tensor], sensors: Mapping[str, Sensor] | None = None
) -> TensorDictBase:
    """Returns sequences ``[N, T]`` with the selected ``rows`` (bool ``[N]``) mirrored left to right."""
    image = mirrored(decisions, rows[:, None], sensors)
    for key, state in starts.items():
        image[key] = torch.where(rows[:, None, None, None], state, decisions[key])
    return image
