"""Policies by name. Does not import PyTorch until a policy is loaded.

The command line, its help and its error messages read this table: a new baseline is a line in :data:`BASELINES`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rover_rl.names import unseen
from rover_rl.registry import Registry, is_path, perhaps
from rover_rl.robots import names_several

if TYPE_CHECKING:
    from rover_rl.algos.config import TrainingConfig
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.policy.runner import Policy
    from rover_rl.envs.config import RobotLike

PRETRAINED = "pretrained:"  # prefix of the names of pretrained policies
RANDOM = "random"  # name of the policy that acts at random
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
FILES = {".onnx": "rover_rl.algos.deploy.export:OnnxPolicy", ".zip": "rover_rl.algos.policy.sb3_policy:SB3Policy"}
"""Classes of policies in files that are no checkpoints, by suffix."""
NAMES = f"pretrained:NAME, {', '.join(BASELINES)}, module:attribute or {RANDOM}"
"""Names of policies, for help and error messages."""
NO_POLICY = f"name a policy: the folder of a run, a checkpoint, {NAMES}"
_REGISTRY = Registry("baseline", BASELINES)


@dataclass(frozen=True)
class ResolvedPolicy:
    """A policy by name.

    Attributes:
        name: name of the policy in tables.
        module: the policy; ``None`` acts at random.
        worlds: worlds to drive in; if empty, those of the other policies.
        folder: folder of its checkpoint; ``None`` if it has none.
        config: settings of its training; ``None`` if it was not trained.
    """

    name: str
    module: Policy | None
    worlds: tuple[str, ...] = ()
    folder: Path | None = None
    config: TrainingConfig | None = None


def resolve_policies(
    names: Sequence[str], worlds: tuple[str, ...] = (), robot: RobotLike | None = None
) -> list[ResolvedPolicy]:
    """Resolves several names, each once: see :func:`resolve_policy`. Policies that are called the same keep theirs."""
    if not names:
        raise ValueError(NO_POLICY)
    policies = {name: resolve_policy(name, worlds, robot) for name in dict.fromkeys(names)}
    count = Counter(policy.name for policy in policies.values())
    return [policy if count[policy.name] == 1 else replace(policy, name=name) for name, policy in policies.items()]


def resolve_policy(name: str, worlds: tuple[str, ...] = (), robot: RobotLike | None = None) -> ResolvedPolicy:
    """Makes or loads a policy.

    Args:
        name: ``random``, a baseline, ``module:attribute``, an ONNX file, a ``.zip`` of Stable-Baselines3, or what
            :func:`load_policy` loads.
        worlds: worlds that it drives in. Default: those of its training, and for a range of seeds one beyond it.
        robot: robot of a baseline.
    """
    if name == RANDOM:
        return ResolvedPolicy(name, None, worlds)
    if is_baseline(name):
        return ResolvedPolicy(name, make_baseline(name, robot), worlds)
    path = Path(name)
    if path.suffix in FILES:
        module = _REGISTRY.find(FILES[path.suffix])(path)
        config, called, folder = getattr(module, "config", None), path.stem, None
    else:
        checkpoint, called = load_policy(name), policy_name(name)
        config, module = checkpoint.config, checkpoint.make_actor()
        folder = None if name.startswith(PRETRAINED) else _folder(path)
    trained = () if config is None else tuple(map(unseen, config.env.world_names))
    return ResolvedPolicy(called, module, worlds or trained, folder, config)


def make_baseline(name: str, robot: RobotLike | None = None) -> Policy:
    """Creates a baseline policy, or one of your own (``"module:attribute"``), for robots or the default one."""
    make = partial(_REGISTRY.call, name, _REGISTRY.find(name))
    if robot is None:
        return make()
    if name in BASELINES and names_several(robot):
        from rover_rl.algos.policy.several_robots import SeveralRobots

        return SeveralRobots(make, robot)
    return make(robot)


def is_baseline(name: str) -> bool:
    """Whether a name is that of a baseline, or the ``"module:attribute"`` of a policy of one's own."""
    return name in BASELINES or (is_path(name) and not name.startswith(PRETRAINED))


def load_policy(name: str) -> Checkpoint:
    """Loads a trained policy: ``pretrained:NAME``, the folder of a run, or a checkpoint file.

    Raises ``FileNotFoundError`` if there is none, and ``ValueError`` for an unknown name or another file.
    """
    from rover_rl.algos.policy.checkpoint import Checkpoint
    from rover_rl.algos.pretrained import load_pretrained, pretrained_names

    if name.startswith(PRETRAINED):
        return load_pretrained(name.removeprefix(PRETRAINED))
    if not Path(name).exists():
        if name in (*BASELINES, RANDOM):
            raise FileNotFoundError(f"no checkpoint at {name}: {name!r} is a policy without training")
        # The name of a pretrained policy, with a typing error or without its prefix.
        names = get_close_matches(name.rpartition(":")[2], pretrained_names(), n=1)
        similar = f", perhaps {PRETRAINED + names[0]!r}" if names else perhaps(name, [*BASELINES, RANDOM])
        raise FileNotFoundError(f"no checkpoint at {name}{similar}")
    return Checkpoint.load(name)


def policy_name(name: str) -> str:
    """Returns what a policy that :func:`load_policy` loads is called in tables, such as the name of its run."""
    return name.removeprefix(PRETRAINED) if name.startswith(PRETRAINED) else _folder(Path(name)).resolve().name


def _folder(path: Path) -> Path:
    return path if path.is_dir() else path.parent
