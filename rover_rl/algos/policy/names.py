"""Policies by name. Does not import PyTorch until a policy is loaded.

The command line, its help and its error messages read this table: a new baseline is a line in :data:`BASELINES`.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from rover_rl.registry import perhaps

if TYPE_CHECKING:
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.policy.runner import Policy
    from rover_rl.envs.config import RobotLike

PRETRAINED = "pretrained:"  # prefix of the names of pretrained policies
BASELINES = {
    "scripted": "rover_rl.algos.policy.baselines:ScriptedPolicy",
    "dwa": "rover_rl.algos.policy.dwa:DynamicWindowPolicy",
    "gridplanner": "rover_rl.algos.policy.grid_planner:GridPlanner",
    "dwa-moving": "rover_rl.algos.policy.moving_dwa:MovingDynamicWindowPolicy",
    "gridplanner-moving": "rover_rl.algos.policy.moving_grid_planner:MovingGridPlanner",
    "orca": "rover_rl.algos.policy.orca:OrcaPolicy",
    "predictive": "rover_rl.algos.policy.predictive:PredictivePolicy",
    "expert": "rover_rl.algos.policy.expert:MapExpert",
    "foresight": "rover_rl.algos.policy.foresight:ForesightPolicy",
}
"""Classes of the baseline policies, ``module:class``, by name. The first argument of each is the robot."""


def make_baseline(name: str, robot: RobotLike | None = None) -> Policy:
    """Creates a baseline policy, for a robot or the default one. Raises ``ValueError`` for an unknown name."""
    if name not in BASELINES:
        raise ValueError(f"unknown baseline {name!r}{perhaps(name, BASELINES)}; use one of {[*BASELINES]}")
    module, _, attribute = BASELINES[name].partition(":")
    policy_class = getattr(import_module(module), attribute)
    return policy_class() if robot is None else policy_class(robot)


def load_policy(name: str) -> Checkpoint:
    """Loads a trained policy: ``pretrained:NAME``, the folder of a run, or a checkpoint file.

    Raises ``FileNotFoundError`` if there is none, and ``ValueError`` for an unknown name or another file.
    """
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.pretrained import load_pretrained

    return load_pretrained(name.removeprefix(PRETRAINED)) if name.startswith(PRETRAINED) else Checkpoint.load(name)


def make_policy(name: str) -> Policy:
    """Creates a baseline policy, or that of a trained one by name: see :func:`load_policy`."""
    return make_baseline(name) if name in BASELINES else load_policy(name).make_actor()
