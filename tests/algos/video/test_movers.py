"""Films of worlds with movers."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.video.film import Style, film
from rover_rl.algos.video.recording import record_endless, record_episodes
from rover_rl.algos.video.views import hides
from rover_rl.envs.config import EnvConfig
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.movers import Cylinder, Mover, Person, Waypoints
from tests.algos.drivers import straight

WARP = EnvConfig(backend="warp")
TO_AND_FRO = Waypoints([(0.0, 2.0, -3.0, 1.57), (6.0, 2.0, 3.0, 1.57)], repeat="back_and_forth")
CROSSING = World("crossing", Terrain.flat((16.0, 16.0)), movers=[Mover(TO_AND_FRO, Person()), Mover(TO_AND_FRO)])
EMPTY = World("crossing", Terrain.flat((16.0, 16.0)))


def frames(path: Path) -> list[np.ndarray]:
    with Image.open(path) as picture:
        found = []
        for index in range(picture.n_frames):
            picture.seek(index)
            found.append(np.asarray(picture.convert("RGB")).astype(int))
        return found


@pytest.mark.parametrize("view", ["chase", "top"])
def test_a_film_shows_movers(view, tmp_path: Path) -> None:
    def violet(world: World) -> list[int]:
        path = tmp_path / "film.gif"
        film(straight, path, Style(view, 240, 180), world=world, seconds=0.6, seed=2, env=WARP)
        return [((p[..., 2] > 1.2 * p[..., 0]) & (p[..., 0] > 1.2 * p[..., 1])).sum() for p in frames(path)]

    around = [Waypoints([(0.0, 4 * math.cos(k), 4 * math.sin(k), 0.0)]) for k in range(6)]
    bare, among = (
        World(
            "ring", Terrain.flat((16.0, 16.0)), spawn_range=((-0.5, 0.5),) * 2, goal_range=((-6, 6),) * 2, movers=movers
        )
        for movers in ([], [Mover(motion, Person()) for motion in around])
    )
    assert min(violet(among)) > 5
    assert max(violet(bare)) == 0


def test_an_episode_is_filmed_with_its_movers() -> None:
    episodes = draw_episodes("plaza:3", 3)
    drives = record_episodes(straight, episodes, seconds=1.0, name="straight", env=WARP)
    again = record_episodes(straight, episodes, [2], seconds=1.0, name="straight", env=WARP)
    last, same = drives[2].moments[-1].movers, again[0].moments[-1].movers
    assert torch.equal(last.position, same.position)
    assert not torch.equal(last.position, drives[0].moments[-1].movers.position)


def test_movers_hide_what_is_behind_them() -> None:
    world = World("pole", Terrain.flat((16.0, 16.0)), movers=[Mover(Waypoints([(0.0, 3.0, 0.0, 0.0)]), Cylinder(0.3))])
    moment = record_endless(straight, world, seconds=0.05, rows=1, seed=0, env=WARP).moments[0]
    points = torch.tensor([[2.6, 0.0, 0.5], [2.7, 0.0, 0.5], [4.0, 0.0, 0.5], [4.0, 1.0, 0.5]])
    assert hides(moment.movers, torch.tensor([0.0, 0.0, 0.5]), points).tolist() == [False, False, True, False]
    # A mover at the camera is not drawn, and hides nothing.
    assert not hides(moment.movers, torch.tensor([2.4, 0.0, 0.5]), points).any()
