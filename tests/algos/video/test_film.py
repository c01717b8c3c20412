from __future__ import annotations

import math
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from rover_rl import RoverEnv, World, make_env
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.video.film import Style, film
from rover_rl.algos.video.recording import record_endless, record_episodes
from rover_rl.algos.video.views import hides, lidar_hits
from rover_rl.cli.film import Film
from rover_rl.sims.rendering.renderer import Camera, Sight
from rover_rl.worlds import Terrain, box
from rover_rl.worlds.movers import Cylinder, Mover, Person, Waypoints
from tests.algos.drivers import straight
from tests.algos.evaluation.drives import WARP

GROUND = Terrain.flat((12.0, 12.0))
FIELD, WALL = World("field", GROUND), World("wall", GROUND, [box((2.0, 0.0, 0.5), (0.4, 4.0, 1.0))])


def chase(env: RoverEnv) -> Camera:
    rover = env.rover_state[0]
    return Camera.on(rover.position, rover.orientation, Sight(env.worlds[0]), "chase")


def test_lines_are_drawn_over_what_the_simulator_renders() -> None:
    yaw = 2.0
    env = RoverEnv(world_n=FIELD, seed=0)
    goal = 4 * torch.tensor([[math.cos(yaw + 0.2), math.sin(yaw + 0.2)]])
    env.reset(start=torch.tensor([[0.0, 0.0, yaw]]), goal=goal)
    picture = env.render(width=320, height=240).int()
    post = (picture[..., 1:2] > picture[..., ::2] + 35).all(-1).nonzero()
    env.close()
    ends = torch.tensor([[*goal[0].tolist(), height] for height in (0.0, 1.2)])
    pixels, seen = chase(env).see(ends, 320, 240)
    pixels = pixels.float()
    assert seen.all()
    # Right and down, with centers of pixels at halves.
    bottom, top = pixels
    rows = torch.arange(round(top[1].item()) + 2, round(bottom[1].item()) - 2)
    assert len(rows) > 30
    columns = torch.stack([post[post[:, 0] == row, 1].float().mean() + 0.5 for row in rows])
    axis = top[0] + (rows + 0.5 - top[1]) / (bottom[1] - top[1]) * (bottom[0] - top[0])
    torch.testing.assert_close(columns, axis, atol=0.8, rtol=0)
    # The camera looks down on the post, so that its rims stand out a little.
    ends = torch.stack((post[:, 0].max(), post[:, 0].min())).float()
    torch.testing.assert_close(ends, pixels[:, 1], atol=3, rtol=0)


def test_the_camera_sees_neither_behind_itself_nor_a_wall_where_lidar_beams_end() -> None:
    with closing(RoverEnv(world_n=WALL, seed=0, backend="warp")) as env:
        env.reset(start=torch.zeros(1, 3))
        camera = chase(env)
        env.reset(start=torch.tensor([[0.0, 0.5, 1.0]]))
        start, hits = lidar_hits(env.rover_state, env.scan, env.robot, env.scanner.angles)
    points = torch.tensor([[1.7, 0.0, 0.5], [1.8, 0.0, 0.5], [3.0, 0.0, 0.2], [3.0, 0.0, 1.5], [-5.0, 0.0, 0.5]])
    pixels, seen = camera.see(points, 320, 240)
    assert seen.tolist() == [True, True, False, True, False]
    assert pixels.isnan().any(-1).tolist() == [False] * 4 + [True]
    assert len(hits) > 10
    torch.testing.assert_close(hits[:, 0], torch.full((len(hits),), 1.8), atol=0.01, rtol=0)
    assert hits[:, 1].abs().max() < 2.01
    torch.testing.assert_close(hits[:, 2], start[2].expand(len(hits)), atol=0.05, rtol=0)


@pytest.mark.parametrize(
    ("style", "seconds", "duration"),
    [({"view": "chase"}, 1.0, 100), ({"view": "top", "speed": 4, "fps": 20}, 2.0, 50)],
    ids=["chase", "fast"],
)
def test_a_gif_has_the_size_and_the_time_asked_for(
    style: dict[str, Any], seconds: float, duration: int, tmp_path: Path
) -> None:
    path, before = tmp_path / "new" / "film.gif", b""
    for _ in range(2):
        film(straight, path, Style(width=99, height=64, **style), world=FIELD, seconds=seconds, seed=3, env=WARP)
        assert before in (b"", path.read_bytes())
        before = path.read_bytes()
    with Image.open(path) as picture:
        assert (picture.size, picture.n_frames, picture.info["duration"]) == ((99, 64), 10, duration)
        assert np.asarray(picture.convert("RGB")).std() > 10
    assert [file.name for file in path.parent.iterdir()] == ["film.gif"]


def test_an_mp4_is_a_film(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / "film.mp4"
    film(None, path, Style("top", 96, 64), world=FIELD, rows=2, seconds=0.5, env=WARP)
    pictures = [np.asarray(picture) for picture in imageio.get_reader(path)]
    assert len(pictures) == 10
    assert pictures[0].shape == (64, 96, 3)


def test_the_first_rover_is_told_of(tmp_path: Path) -> None:
    told = film(straight, tmp_path / "film.gif", Style("top", 64, 48), world=WALL, rows=2, seconds=8, seed=1, env=WARP)
    env = make_env(world_n=WALL, num_envs=2, seed=1, backend="warp")
    expected = env.rollout(160, straight, break_when_any_done=False)[0]
    env.close()
    assert told.batch_size == (160,)
    for key in (("next", "pose"), ("next", "reward"), ("next", "outcome", "phase")):
        assert torch.equal(told[key], expected[key])


@pytest.mark.parametrize(
    ("name", "style", "seconds", "message"),
    [
        ("film.avi", Style(), 1.0, r"must be \.mp4 or \.gif, got .*film\.avi"),
        ("film.gif", Style(), 0.0, "seconds must be positive"),
        ("film.gif", Style("side"), 1.0, "unknown view 'side'"),
        ("film.mp4", Style(), 1.0, r'pip install "rover_rl\[video\]"'),
    ],
)
def test_what_cannot_be_filmed_is_refused(
    name: str, style: Style, seconds: float, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ValueError, match=message):
        film(None, tmp_path / name, style, seconds=seconds)
    assert not list(tmp_path.iterdir())


def test_the_command_films_and_draws_rewards(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, rewards = tmp_path / "film.gif", tmp_path / "rewards.png"
    assert Film("scripted", out=out, view="top", rovers=2, seconds=0.5, width=64, height=48, rewards=rewards)() == 0
    assert capsys.readouterr().out == f"Film: {out}\nRewards: {rewards}\n"
    assert out.is_file()
    assert rewards.is_file()


# --- movers


@pytest.mark.parametrize("view", ["chase", "top"])
def test_a_film_shows_movers(view, tmp_path: Path) -> None:
    def violet(movers: list[Mover]) -> list[int]:
        area, path = ((-0.5, 0.5),) * 2, tmp_path / "film.gif"
        world = World("ring", Terrain.flat((16.0, 16.0)), spawn_range=area, goal_range=((-6, 6),) * 2, movers=movers)
        film(straight, path, Style(view, 240, 180), world=world, seconds=0.3, seed=2, env=WARP)
        with Image.open(path) as picture:
            count = picture.n_frames
            frames = [np.asarray(picture.convert("RGB")).astype(int) for k in range(count) if picture.seek(k) is None]
        return [((p[..., 2] > 1.2 * p[..., 0]) & (p[..., 0] > 1.2 * p[..., 1])).sum() for p in frames]

    around = [Waypoints([(0.0, 4 * math.cos(k), 4 * math.sin(k), 0.0)]) for k in range(6)]
    assert min(violet([Mover(motion, Person()) for motion in around])) > 5
    assert max(violet([])) == 0


def test_an_episode_is_filmed_with_its_movers() -> None:
    episodes = draw_episodes("plaza:3", 3)
    drives = record_episodes(straight, episodes, seconds=0.5, name="straight", env=WARP)
    again = record_episodes(straight, episodes, [2], seconds=0.5, name="straight", env=WARP)
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
