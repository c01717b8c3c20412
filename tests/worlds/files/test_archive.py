"""The project's own world files, and the commands that write and draw them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from rover_rl.cli.main import main
from rover_rl.progress import redirected_progress
from rover_rl.worlds import Region, Terrain, World, box, cylinder, get_world
from rover_rl.worlds.movers import Box, Mover, Person, Wander, Waypoints
from tests.extras import needs_worlds
from tests.worlds.files.test_areas import building, rectangle
from tests.worlds.files.test_maps import write_map
from tests.worlds.files.test_sdf import PLANE

MOVERS = (
    Mover(Waypoints([(0.0, 0.5, 1.0, 0.0), (2.5, 1.0, 2.0, 0.3)], "once", delay=1.0), Person(1.6), "walker"),
    Mover(Wander(0.7, area=((0.0, 8.0), (-1.0, 8.0))), Box(0.4, 0.5, 0.6)),
)


def plain() -> World:
    heights = 0.1 * np.random.default_rng(0).standard_normal((41, 51))
    return World(
        "plain",
        Terrain(heights, 0.5, (-3.0, -4.0)),
        [box((2, 1, 0.5), (1, 2, 1), yaw=0.3), cylinder((5, 5, 0.5), 0.5, 1.0)],
        spawn_range=((0.0, 8.0), (-1.0, 8.0)),
        spawn_region=Region.polygon([(0, 0), (6, 0), (6, 2), (2, 2), (2, 6), (0, 6)]),
        goal_range=((1.0, 8.0), (-1.0, 8.0)),
        bounds=((-3.0, 10.0), (-4.0, 10.0)),
        spawn_height=0.5,
        spawn_height_areas=((((0.0, 1.0), (0.0, 1.0)), 2.0),),
        movers=MOVERS,
        notes=("ground: fine",),
    )


def test_a_world_file_gives_the_same_world_without_the_extra(tmp_path):
    world, path = plain(), tmp_path / "folder" / "plain.world.npz"
    world.save(path)
    read = World.from_file(path)
    areas = ("spawn_range", "goal_range", "bounds", "spawn_height_areas")
    for name in ("name", *areas, "spawn_height", "movers", "notes"):
        assert getattr(read, name) == getattr(world, name), name
    assert torch.equal(read.terrain.heights, world.terrain.heights)
    assert (read.terrain.cell, read.terrain.origin) == (world.terrain.cell, world.terrain.origin)
    for ours, theirs in zip(read.obstacles, world.obstacles, strict=True):
        assert torch.equal(ours.vertices, theirs.vertices)
    assert torch.equal(read.spawn_region.mask, world.spawn_region.mask)
    assert (read.spawn_region.cell, read.spawn_region.origin) == (world.spawn_region.cell, world.spawn_region.origin)
    assert read.goal_region is None
    with np.load(path, allow_pickle=False) as file:
        assert {*file.files} == {"about", "heights", "vertices", "ends", "spawn_region"}


def test_a_world_without_obstacles_can_be_saved(tmp_path):
    everywhere = (((-math.inf, math.inf), (-math.inf, 0.0)), 2.0)
    World("bare", Terrain.flat((10, 10)), spawn_height_areas=(everywhere,)).save(tmp_path / "bare.world.npz")
    world = get_world(str(tmp_path / "bare.world.npz"))
    assert (len(world.obstacles), world.spawn_height_areas) == (0, (everywhere,))
    with pytest.raises(ValueError, match=r"must end in \.world\.npz, got 'plain\.npz'"):
        world.save(tmp_path / "plain.npz")
    with pytest.raises(ValueError, match=r"is imported already: give \['cell'\] when it is imported"):
        World.from_file(tmp_path / "bare.world.npz", cell=1.0)


def test_import_and_show(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source, out, picture = write_map(tmp_path), tmp_path / "room.world.npz", tmp_path / "room.png"
    given = ["--spawn", "0", "2", "-1.5", "1.5", "--bounds", "-1", "5", "-2", "2", "--name", "room"]
    assert main(["worlds", "import", str(source), "--out", str(out), *given]) == 0
    told = capsys.readouterr().out
    assert "room: 5 obstacles" in told
    assert "start area: x 0.0 to 2.0 m, y -1.5 to 1.5 m" in told
    assert "% of the cells are unknown" in told
    world = World.from_file(out)
    assert (world.name, world.spawn_range) == ("room", ((0.0, 2.0), (-1.5, 1.5)))
    assert main(["worlds", "show", str(out), "--out", str(picture)]) == 0
    assert "shortest path from a start to a goal" in capsys.readouterr().out
    assert picture.read_bytes().startswith(b"\x89PNG")


@needs_worlds
def test_messages_name_options_as_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, plane = tmp_path / "cave.sdf", PLANE.format(size="9 9")
    path.write_text(
        f"<sdf version='1.9'><world name='w'>{plane}<include><uri>model://bat</uri></include></world></sdf>"
    )
    command = ["worlds", "import", str(path), "--out", str(tmp_path / "cave.world.npz")]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert "with --model-paths, download them, or leave them out with --missing skip" in error
    assert (error.startswith("rover-rl: "), error.count("\n")) == (True, 1)
    assert main(["evaluate", "scripted", "--world", str(path)]) == 2
    assert "leave them out with rover-rl worlds import --missing skip" in capsys.readouterr().err
    assert main([*command, "--missing", "skip"]) == 0
    assert "left out, as --missing skip says: model://bat is not found" in capsys.readouterr().out
    with pytest.raises(ValueError, match='with model_paths, download them, or leave them out with missing="skip"'):
        World.from_file(path)
    assert main([*command, "--missing", "skip", "--spawn", "1", "2", "3"]) == 2
    assert "--spawn takes 2 numbers" in capsys.readouterr().err


@needs_worlds
def test_an_import_shows_its_progress(tmp_path: Path) -> None:
    shares: list[float] = []
    with redirected_progress(shares.append):
        building(tmp_path, *rectangle(0, 0, 8, 6))
    assert shares == [0.0, 0.25, 0.5, 0.75, 1.0]
