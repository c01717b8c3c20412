"""Whether a reward pays for reaching a goal, found by trying it on made-up steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from rover_rl.envs.config import EnvConfig
from rover_rl.envs.sensors.suite import environment_sensors
from rover_rl.envs.specs import action_bounds, bounded_spec, observation_spec
from rover_rl.envs.task import EVENTS, StepEvent

_STEPS = 64
"""Number of steps that a reward is tried on, so that one that pays under a condition only is found, too."""


def pays_for_goals(components: Sequence[Transform], env: EnvConfig | None = None) -> bool:
    """Returns whether a component of a reward pays more for a step because it reaches a goal.

    Each component is given pairs of steps with the same random measurements: one reaches the goal, and the other does
    not. A component that is limited to other events than a goal does not pay for one. A component that cannot be tried
    alone, because it reads what other transforms add, is taken to pay.

    Args:
        components: components of the reward, as :func:`~rover_rl.envs.rewards.reward_components` returns them. The
            reward without components is that of the bare task, which pays.
        env: description of the environment; ``None``: the default one.

    Example:
        >>> from rover_rl.envs.rewards import contract_reward
        >>> pays_for_goals(contract_reward()), pays_for_goals(contract_reward()[1:])
        (True, False)
    """
    return not components or any(_pays(component, env or EnvConfig()) for component in components)


def _pays(component: Transform, env: EnvConfig) -> bool:
    phases = getattr(component, "phases", ())
    if phases and StepEvent.GOAL not in phases:
        return False
    try:
        with torch.no_grad():
            reached, missed = (_value(component, *_step(env, goal)) for goal in (True, False))
    except Exception:  # The user's code can raise anything.
        return True
    return bool((reached > missed).any())


def _value(component: Transform, before: TensorDictBase, after: TensorDictBase) -> Tensor:
    """Value of a component in each step, ``[N]``."""
    after = component._step(before, after)
    return torch.cat(list(after["reward_components"].values()), -1).sum(-1)


def _step(env: EnvConfig, goal: bool) -> tuple[TensorDictBase, TensorDictBase]:
    """Makes up the observations before and after some steps, the same ones at each call."""
    generator = torch.Generator().manual_seed(0)
    sensors = environment_sensors(env.lidar, env.own_sensors, env.late_scans, env.randomization.hides_beams)
    bounds = {key: sensor.bounds for key, sensor in sensors.items()}
    spec = observation_spec(bounds, (_STEPS,), None, privileged=env.privileged)

    def drawn() -> TensorDictBase:
        made: TensorDictBase = spec.zero()
        for key in made.keys(True, True):
            if made[key].is_floating_point():
                made[key] = torch.rand(made[key].shape, generator=generator)
        outcome = made["outcome"]
        for event in EVENTS:
            outcome[event] = torch.full((_STEPS, 1), goal and event == "goal_reached")
        outcome["phase"] = torch.full((_STEPS, 1), int(StepEvent.GOAL if goal else StepEvent.DENSE))
        for count in ("steps", "total_steps"):
            outcome[count] = torch.randint(1, env.length + 1, (_STEPS, 1), generator=generator)
        return made

    action = bounded_spec(action_bounds(env.bounded_action), (_STEPS,), None).zero()
    before: TensorDictBase = drawn().set("action", action)
    nothing = TensorDict({"reward": torch.zeros(_STEPS, 1), "done": torch.zeros(_STEPS, 1, dtype=torch.bool)}, [_STEPS])
    return before, drawn().update(nothing)
