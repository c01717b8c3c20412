"""Comparison of the same policy on the same episodes in several backends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from rover_rl.algos.evaluation.results import EndlessEvaluation, Evaluation


@dataclass(frozen=True)
class Disagreement:
    """An episode that reaches its goal in one backend and not in another.

    Attributes:
        policy: name of the policy.
        world: name of the world.
        episode: index of the episode in its set, from 0.
        start: start pose: x, y (m) and yaw (rad).
        goal: goal: x, y, m.
        endings: ending of the episode in each backend, by name.
    """

    policy: str
    world: str
    episode: int
    start: tuple[float, ...]
    goal: tuple[float, ...]
    endings: dict[str, str]

    def to_json(self) -> dict[str, Any]:
        """Returns the episode and its endings as plain data, without what all disagreements of an evaluation share."""
        return {"episode": self.episode, "start": self.start, "goal": self.goal, "endings": self.endings}


def find_disagreements(evaluations: Sequence[Evaluation | EndlessEvaluation]) -> list[Disagreement] | None:
    """Finds the episodes that reach their goal in one backend and not in another.

    Compares evaluations with one goal per episode, of policies of the same name on the same episodes with the same time
    limit. Episodes in endless mode are not compared, since their goals depend on the goals before.

    Args:
        evaluations: evaluations of any policies, worlds, modes and backends.

    Returns:
        The disagreements; ``None`` if there is nothing to compare.
    """
    groups = _comparable(evaluations)
    return [one for group in groups for one in _disagreements(group)] if groups else None


def disagreements_of(
    evaluation: Evaluation | EndlessEvaluation, evaluations: Sequence[Evaluation | EndlessEvaluation]
) -> list[Disagreement] | None:
    """Returns the disagreements of an evaluation with those of the same policy in other backends.

    Args:
        evaluation: evaluation of one of the backends.
        evaluations: evaluations that it may be compared with; may contain itself.

    Returns:
        The disagreements; ``None`` if there is nothing to compare the evaluation with.
    """
    group = next((group for group in _comparable(evaluations) if any(one is evaluation for one in group)), None)
    return None if group is None else _disagreements(group)


def backends_of(evaluations: Sequence[Evaluation | EndlessEvaluation]) -> list[str]:
    """Returns the names of the backends in which policies are compared, in order; empty if no policy is in several."""
    backends: dict[str, dict[str, None]] = {}
    for evaluation in evaluations:
        backends.setdefault(evaluation.name, {})[evaluation.backend] = None
    if all(len(names) == 1 for names in backends.values()):
        return []
    return list(dict.fromkeys(evaluation.backend for evaluation in evaluations))


def _disagreements(group: Sequence[Evaluation]) -> list[Disagreement]:
    """Disagreements of evaluations of a policy on the same episodes in several backends."""
    reached, episodes = torch.stack([evaluation.reached for evaluation in group]), group[0].episodes
    return [
        Disagreement(
            policy=group[0].name,
            world=episodes.world_name(episode),
            episode=episode,
            start=tuple(episodes.start[episode].tolist()),
            goal=tuple(episodes.goal[episode].tolist()),
            endings={evaluation.backend: evaluation.endings[episode] for evaluation in group},
        )
        for episode in (reached.any(0) & ~reached.all(0)).nonzero().squeeze(-1).tolist()
    ]


def _comparable(evaluations: Sequence[Evaluation | EndlessEvaluation]) -> list[list[Evaluation]]:
    """Groups of evaluations in several backends of the same policy on the same episodes, one for each backend."""
    groups: list[list[Evaluation]] = []
    for evaluation in evaluations:
        if not isinstance(evaluation, Evaluation):
            continue
        fitting = (
            group
            for group in groups
            if _same_episodes(group[0], evaluation) and evaluation.backend not in {one.backend for one in group}
        )
        if (group := next(fitting, None)) is None:
            groups.append([evaluation])
        else:
            group.append(evaluation)
    return [group for group in groups if len(group) > 1]


def _same_episodes(one: Evaluation, other: Evaluation) -> bool:
    """Whether two evaluations are of a policy of the same name on the same episodes."""
    if any(getattr(one, key) != getattr(other, key) for key in ("name", "world_name", "title", "action_repeat")):
        return False
    a, b = one.episodes, other.episodes
    return all(torch.equal(getattr(a, key), getattr(b, key)) for key in ("start", "goal", "world_index"))
