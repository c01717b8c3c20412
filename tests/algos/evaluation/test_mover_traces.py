"""Movers in pictures of driven paths."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import Evaluation, evaluate
from rover_rl.algos.evaluation.plots import draw_mover_traces, draw_paths
from rover_rl.algos.evaluation.trajectory import MoverTrack, Trajectory
from rover_rl.envs import EnvConfig
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Cylinder, Mover, Person, Waypoints
from tests.algos.drivers import standing
from tests.algos.evaluation.drives import line

LINE = Waypoints([(0.0, 2.0, -3.0, 1.57), (6.0, 2.0, 3.0, 1.57)], repeat="back_and_forth")
CROSSING = World("crossing", Terrain.flat((12.0, 12.0)), movers=[Mover(LINE, Person()), Mover(LINE, Cylinder(0.4))])
LEGEND = "<!-- mover at the end, its last 3 s -->"


@cache
def driven(track_movers: bool | float, seconds: float = 4.0) -> Evaluation:
    """A rover that stands still while movers pass by."""
    options = {"seconds": seconds, "name": "standing", "env": EnvConfig(backend="warp")}
    return evaluate(standing, draw_episodes(CROSSING, 1), track_movers=track_movers, **options)


def ended(ending: str, *xs: float) -> Trajectory:
    """An episode that ends at (1, 0), with cylinders that end at ``xs`` and come from the left."""
    position = torch.zeros(81, len(xs), 3)
    position[..., 0] = torch.tensor(xs) + torch.linspace(-4, 0, 81)[:, None]
    turn = torch.tensor([0.0, 0.0, 0.0, 1.0]).expand(81, len(xs), 4)
    half = torch.full((len(xs), 3), 0.3)
    track = MoverTrack(torch.zeros(len(xs), dtype=torch.int32), half, torch.arange(len(xs)), position, turn)
    episode = line(ending, (-3.0, 0.0), (1.0, 0.0), steps=80)
    return Trajectory(**{**vars(episode), "movers": track})


def outlines(trajectory: Trajectory, alone: bool) -> list[float]:
    """The centers (x) of the movers that are drawn."""
    ax = Figure().add_subplot()
    draw_mover_traces(ax, CROSSING, trajectory, alone)
    *traces, shapes = ax.collections or [None]
    if shapes is None:
        return []
    for trace, shape in zip(traces, shapes.get_paths(), strict=True):
        segments = np.array(trace.get_segments())
        # Three seconds at 1 m/s, up to the outline.
        assert segments[-1, 1, 0] - segments[0, 0, 0] == pytest.approx(3.0, abs=1e-4)
        assert segments[-1, 1, 0] == pytest.approx(shape.vertices[:-1, 0].mean(), abs=0.05)
        assert (np.diff(trace.get_colors()[:, 3]) > 0).all()
    return [round(float(path.vertices[:-1, 0].mean()), 1) for path in shapes.get_paths()]


def test_movers_near_the_end_of_a_failure_are_drawn() -> None:
    assert outlines(ended("jammed", 1.5, 4.0), alone=False) == [1.5]
    assert outlines(ended("goal", 1.5, 4.0), alone=False) == []


@pytest.mark.parametrize("ending", ["goal", "jammed"])
def test_all_movers_of_a_single_episode_are_drawn(ending: str) -> None:
    assert outlines(ended(ending, 1.5, 4.0), alone=True) == [1.5, 4.0]


def test_a_picture_names_movers_if_there_are_any(tmp_path: Path) -> None:
    for track, named in ((True, True), (False, False)):
        draw_paths([driven(track)], tmp_path / "paths.svg")
        assert (LEGEND in (tmp_path / "paths.svg").read_text()) == named


def test_the_first_steps_of_an_episode_have_the_first_part_of_its_track() -> None:
    whole, part = (driven(track).trajectories[0] for track in (True, 3.0))
    assert torch.equal(whole.until(40, "contact").movers.position, whole.movers.position[:41])
    assert torch.equal(part.until(40, "contact").movers.position, whole.movers.position[20:41])
    assert len(part.until(10, "contact").movers.position) == 0
