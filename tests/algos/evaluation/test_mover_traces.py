"""Movers in pictures of driven paths."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import torch

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.algos.evaluation.plots import draw_paths
from rover_rl.envs.config import EnvConfig
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Cylinder, Mover, Person, Waypoints
from tests.algos.drivers import standing

LINE = Waypoints([(0.0, 2.0, -3.0, 1.57), (6.0, 2.0, 3.0, 1.57)], repeat="back_and_forth")
CROSSING = World("crossing", Terrain.flat((12.0, 12.0)), movers=[Mover(LINE, Person()), Mover(LINE, Cylinder(0.4))])
LEGEND = "<!-- mover at the end, its last 3 s -->"


@cache
def driven(track_movers: bool | float, seconds: float = 4.0) -> Evaluation:
    """A rover that stands still while movers pass by."""
    options = {"seconds": seconds, "name": "standing", "env": EnvConfig(backend="warp")}
    return evaluate(standing, draw_episodes(CROSSING, 1), track_movers=track_movers, **options)


def test_a_picture_names_movers_if_there_are_any(tmp_path: Path) -> None:
    for track, named in ((True, True), (False, False)):
        draw_paths([driven(track)], tmp_path / "paths.svg")
        assert (LEGEND in (tmp_path / "paths.svg").read_text()) == named


def test_the_first_steps_of_an_episode_have_the_first_part_of_its_track() -> None:
    whole, part = (driven(track).trajectories[0] for track in (True, 3.0))
    assert torch.equal(whole.until(40, "contact").movers.position, whole.movers.position[:41])
    assert torch.equal(part.until(40, "contact").movers.position, whole.movers.position[20:41])
    assert len(part.until(10, "contact").movers.position) == 0
