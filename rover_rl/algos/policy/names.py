"""Policies by name. Does not import PyTorch until a policy is loaded.

The command line, its help and its error messages read this table: a new baseline is a line in :data:`BASELINES`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rover_rl.registry import Registry, is_path

if TYPE_CHECKING:
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.policy.runner import Policy
    from rover_rl.envs.config import RobotLike

PRETRAINED = "pretrained:"  # prefix of the names of pretrained policies
BASELINES = {
    "scripted": "rover_rl.algos.policy.baselines:ScriptedPolicy",
    "dwa": "rover_rl.algos.policy.dwa:DynamicWindowPolicy",
    "gridplanner": "rover_rl.algos.policy.grid_planner:GridPlanner",
    "dwa-moving": "rover_rl.algos.policy.dwa:MovingDynamicWindowPolicy",
    "gridplanner-moving": "rover_rl.algos.policy.grid_planner:MovingGridPlanner",
    "orca": "rover_rl.algos.policy.orca:OrcaPolicy",
    "predictive": "rover_rl.algos.policy.predictive:PredictivePolicy",
    "expert": "rover_rl.algos.policy.expert:MapExpert",
}
"""Classes of the baseline policies, ``module:class``, by name. The first argument of each is the robot."""
_REGISTRY = Registry("baseline", BASELINES)


def make_baseline(name: str, robot: RobotLike | None = None) -> Policy:
    """Creates a baseline policy, or one of your own (``"module:attribute"``), for a robot or the default one.

    Raises ``ValueError`` for an unknown name.
    """
    return _REGISTRY.call(name, _REGISTRY.find(name), *(() if robot is None else (robot,)))


def load_policy(name: str) -> Checkpoint:
    """Loads a trained policy: ``pretrained:NAME``, the folder of a run, or a checkpoint file.

    Raises ``FileNotFoundError`` if there is none, and ``ValueError`` for an unknown name or another file.
    """
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.pretrained import load_pretrained

    return load_pretrained(name.removeprefix(PRETRAINED)) if name.startswith(PRETRAINED) else Checkpoint.load(name)


def is_baseline(name: str) -> bool:
    """Whether a name is that of a baseline, or the ``"module:attribute"`` of a policy of one's own."""
    return name in BASELINES or (is_path(name) and not name.startswith(PRETRAINED))


def make_policy(name: str) -> Policy:
    """Creates a baseline policy, or that of a trained one by name: see :func:`load_policy`."""
    return make_baseline(name) if is_baseline(name) else load_policy(name).make_actor()
