"""``PlainPolicy``: everything that a policy computes, as one module on plain tensors, for export."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from rover_rl.algos.config import NetworkConfig
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import action_spec
from rover_rl.algos.policy.recurrent import RecurrentStep
from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.seen_map.seen_map import BOUNDS, ROUTE_KEYS
from rover_rl.envs.sensors.robot import RobotNumbers
from rover_rl.envs.sensors.suite import LIDAR_MASK, MOVERS, ROBOT, ROUTE, WALLS
from rover_rl.robots import get_robot

STATE_IN, STATE_OUT = "state_in", "state_out"  # names of the state, before and after a decision
ExportedFunction: TypeAlias = Callable[[dict[str, Any]], Any]
"""Exported policy: function from inputs by name to an action ``[1, 2]``. With a state, the inputs include ``state_in``,
and the function returns the action and ``state_out``."""


def input_names(network: NetworkConfig) -> list[str]:
    """Returns the inputs of an exported policy: in place of ``route``, what it is computed from, and no ``robot``."""
    with_map = ROUTE in network.observation
    state = [STATE_IN] if with_map or network.memory != "none" else []
    of_map = (*ROUTE_KEYS, BOUNDS) if with_map else ()
    return [*state, *dict.fromkeys((*(key for key in network.observation if key not in (ROUTE, ROBOT)), *of_map))]


class PlainPolicy(nn.Module):
    """A checkpoint's policy as a module that maps tensors of observations to a tensor of actions.

    A policy that reads ``robot`` is told the robot of its settings. The ``state_size`` entries of state hold the map of
    what the lidar has seen, if the policy reads ``route``, and then the state of the memory. ``inputs`` and ``outputs``
    are the names of arguments and results.

    Raises:
        ValueError: for a policy that reads ``movers`` or ``walls``, whose tracks the exported map does not keep, and
            for one that reads ``route`` but not ``lidar_mask``, if its training hid beams.
    """

    _robot: Tensor
    _low: Tensor
    _high: Tensor

    def __init__(self, checkpoint: Checkpoint) -> None:
        super().__init__()
        actor, settings = checkpoint.make_actor(), checkpoint.config.network
        for key in {MOVERS, WALLS} & {*settings.observation}:
            raise ValueError(
                f"a policy that reads {key} cannot be exported: its tracks are no part of the exported map"
            )
        hides_beams = checkpoint.env.randomization.hides_beams
        if hides_beams and ROUTE in settings.observation and LIDAR_MASK not in settings.observation:
            raise ValueError(
                f"a policy that reads {ROUTE} and was trained with hidden beams can be exported only if it reads "
                f"{LIDAR_MASK}, too: the exported map would take them for free"
            )
        self._observation = tuple(settings.observation)
        memory = settings.memory != "none"
        self._network = RecurrentStep(actor[0]) if memory else actor[0].module
        self._memory_size: int = self._network.state_size if memory else 0
        self._map, self._map_size = None, 0
        if ROUTE in settings.observation:
            # Importing NVIDIA Warp takes half a second.
            from rover_rl.envs.seen_map.plain_map import PlainSeenMap

            interval = checkpoint.config.collection.action_repeat * checkpoint.env.control_dt
            self._map = PlainSeenMap(checkpoint.env.lidar, checkpoint.env.robot, interval)
            self._map_size = self._map.state_size
        self.state_size = self._map_size + self._memory_size
        self.inputs = input_names(settings)
        self.outputs = ["action", *([STATE_OUT] if self.state_size else [])]
        if ROBOT in settings.observation:
            self.register_buffer("_robot", robot_numbers(checkpoint))
        space = action_spec(checkpoint.env.bounded_action).space
        self.register_buffer("_low", space.low)
        self.register_buffer("_high", space.high)

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """Returns the action ``[N, 2]``, with a state also the next state ``[N, s]``, for the inputs ``[N, n]``."""
        entries, states = dict(zip(self.inputs, inputs, strict=True)), []
        if self._map is not None:
            read = [entries[key] for key in (*ROUTE_KEYS, BOUNDS)] + [entries.get(k) for k in (SCAN_POSE, LIDAR_MASK)]
            entries[ROUTE], state = self._map(entries[STATE_IN][:, : self._map_size], *read)
            states.append(state)
        if ROBOT in self._observation:
            entries[ROBOT] = self._robot.expand(len(inputs[0]), -1)
        observation, bounds = [entries[key] for key in self._observation], []
        if self._memory_size:
            loc, state = self._network(entries[STATE_IN][:, self._map_size :], *observation)
            states.append(state)
        else:
            loc, _, *bounds = self._network(*observation)
        low, high = bounds or (self._low, self._high)
        action = (high + low) / 2 + (high - low) / 2 * torch.tanh(loc)
        return (action, torch.cat(states, -1)) if states else action


def robot_numbers(checkpoint: Checkpoint) -> Tensor:
    """Returns what the sensor ``robot`` tells of a checkpoint's robot, ``[1, 12]``."""
    return torch.cat(RobotNumbers.of_robot(get_robot(checkpoint.env.robot), torch.zeros(1, 1)), -1)


def finite_arrays(inputs: Mapping[str, Any], names: Sequence[str]) -> list[NDArray[np.float32]]:
    """Returns the inputs with the given names. Raises ``ValueError`` for NaN or infinity, which networks accept."""
    arrays = [np.asarray(inputs[name], np.float32) for name in names]
    for name, array in zip(names, arrays, strict=True):
        if not np.isfinite(array).all():
            raise ValueError(f"observation {name!r} holds NaN or infinity: the policy does not act on it")
    return arrays
