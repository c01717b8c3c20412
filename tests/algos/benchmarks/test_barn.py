"""BARN: worlds from the public files and from arrays, the rules of a run, and its score."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rover_rl.algos.benchmarks.barn import TEST_WORLDS, Barn, read_barn
from rover_rl.algos.benchmarks.suite import Course, run_suite
from rover_rl.robots import get_robot
from tests.algos.benchmarks.mini import CENTERS, write_barn_file, write_barn_folder
from tests.algos.drivers import straight
from tests.algos.evaluation.drives import WARP, line


@pytest.fixture(scope="module")
def repository(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_barn_folder(tmp_path_factory.mktemp("barn"))


@pytest.fixture
def courses(repository: Path) -> list[Course]:
    return read_barn(repository)


def test_the_worlds_of_the_repository(repository: Path, courses: list[Course]) -> None:
    assert (len(TEST_WORLDS), TEST_WORLDS[:3], TEST_WORLDS[-1]) == (50, (0, 6, 12), 294)
    assert [course.number for course in courses] == [1, 7]
    for course in courses:
        assert (course.start, course.goal) == ((-2.25, 3.0, math.pi / 2), (-2.25, 13.0))
        outlines = [obstacle.footprint for obstacle in course.world.obstacles]
        assert [outline.mean(0).tolist() for outline in outlines] == [pytest.approx(c) for c in CENTERS[course.number]]
        # The polygons are within 2 mm of the circles of 0.075 m.
        edges = [(outline + outline.roll(1, 0)) / 2 - outline.mean(0) for outline in outlines]
        assert min(edge.norm(dim=1).min().item() for edge in edges) > 0.073
        assert {obstacle.vertices[:, 2].max().item() for obstacle in course.world.obstacles} == {1.0}
    # Start, cells at x = -4.575 + 0.15 column and y = 5.075 + 0.15 row, goal.
    points = [(-2.25, 3.0), (-3.075, 5.825), (-3.075, 9.425), (-2.25, 13.0)]
    expected = sum(math.dist(a, b) for a, b in pairwise(points))
    assert courses[1].length == pytest.approx(expected)
    assert [course.number for course in read_barn(repository / "jackal_helper/worlds/BARN", [7])] == [7]


def test_arrays_give_the_same_worlds(courses: list[Course], tmp_path: Path) -> None:
    path = write_barn_file(tmp_path / "barn.npz", [course.length for course in courses])
    for ours, theirs in zip(read_barn(path, [7, 1]), courses[::-1], strict=True):
        assert (ours.number, ours.length) == (theirs.number, theirs.length)
        solids = zip(ours.world.obstacles, theirs.world.obstacles, strict=True)
        assert all(torch.equal(one.vertices, other.vertices) for one, other in solids)


def test_the_score_of_a_run(courses: list[Course]) -> None:
    course = Course(1, courses[0].world, courses[0].start, courses[0].goal, length=12.0)  # OT = 6 s
    # Faster than 2 OT, between, and slower than 8 OT.
    for seconds, expected in ((5.0, 0.5), (12.0, 0.5), (24.0, 0.25), (48.0, 0.125), (90.0, 0.125)):
        for ending, score in (("goal", expected), ("contact", 0.0), ("time limit", 0.0)):
            assert Barn([course]).score(course, line(ending, steps=round(seconds / 0.05))) == pytest.approx(score)


def test_a_contact_ends_a_run_as_a_failure(courses: list[Course]) -> None:
    suite = Barn(courses)
    suite.seconds = 12.0  # A rover that has touched drives on until then.
    (result,) = run_suite(suite, {"straight": (straight, WARP)})
    reached, touched = result.evaluation.trajectories
    assert (reached.ending, touched.ending) == ("goal", "contact")
    # 9 m at 1 m/s, and the front is 0.2635 m ahead of the center.
    assert reached.seconds == pytest.approx(9.3, abs=0.4)
    assert touched.path[-1, 1] == pytest.approx(6 - 0.075 - 0.2635, abs=0.08)
    flags = result.evaluation.contacts
    assert flags[1].tolist() == [False] * len(touched) + [True]
    assert result.scores.tolist() == [[pytest.approx(0.5, abs=0.03)], [0.0]]
    assert result.metrics["contact_rate"].value == 0.5
    assert result.metrics["score"].value == pytest.approx(result.scores.mean().item())
    assert result.worst(1) == [1]
    row = result.rows()[1]
    assert (row["world"], row["run"], row["ending"], row["score"]) == (7, 0, "contact", 0.0)


def test_starts_are_jittered_after_the_first_run(courses: list[Course]) -> None:
    robot = get_robot("rover_zero")
    starts = Barn(courses, runs=4, seed=3).episodes(robot).start.reshape(2, 4, 3)
    given = torch.tensor(courses[0].start)
    assert torch.equal(starts[:, 0], given.expand(2, 3))
    offsets = (starts[:, 1:] - given).abs()
    assert (offsets > 0).all()
    assert (offsets <= torch.tensor((0.0501, 0.0501, 0.1001))).all()
    assert len(starts.reshape(-1, 3).unique(dim=0)) == 7
    # A run depends neither on the other worlds nor on the number of runs.
    assert torch.equal(Barn(courses[1:], runs=2, seed=3).episodes(robot).start, starts[1, :2])
    assert not torch.equal(Barn(courses, runs=4, seed=4).episodes(robot).start.reshape(2, 4, 3), starts)


XML, PATH = "world_7.world", "path_files/path_7.npy"  # a world and its reference path, in the folder of the worlds


def replaced(old: str, new: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(path.read_text().replace(old, new))


def saved(values: Any) -> Callable[[Path], object]:
    return lambda path: np.save(path, np.array(values), allow_pickle=True)


@pytest.mark.parametrize(
    ("file", "damage", "message"),
    [
        (PATH, saved([{}]), r"path_7\.npy is damaged, no NumPy file, or has pickled objects, which are not read$"),
        (PATH, saved([[0.0] * 3] * 4), r"path_7\.npy must be numbers of the shape any x 2, got float64 \[4, 3\]$"),
        (PATH, saved([[math.inf, 0.0]]), "the reference path of .*world_7.world must have finite cells$"),
        (XML, replaced("<radius>0.075", "<radius>0.2"), "a cylinder has the radius 0.2 m, not 0.075 m$"),
        (XML, lambda path: path.write_text("<sdf"), "world_7.world is not valid XML: "),
    ],
)
def test_damaged_worlds_are_refused_in_a_sentence(
    tmp_path: Path, file: str, damage: Callable[[Path], object], message: str
) -> None:
    folder = write_barn_folder(tmp_path)
    damage(folder / "jackal_helper/worlds/BARN" / file)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        read_barn(folder)


def test_arrays_that_do_not_match_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "barn.npz"
    arrays = dict(np.load(write_barn_file(path, [11.0, 12.0])))
    mismatch = "the arrays of .* do not match"
    for name, wrong, message in (
        *(("offsets", np.array(wrong), mismatch) for wrong in ([0, 2], [0, 4, 2])),
        ("path_length", np.array([11.0]), mismatch),
        ("path_length", np.array([11.0, math.nan]), "the reference path of world 7 in .* must have a positive length"),
    ):
        np.savez(path, **(arrays | {name: wrong}))
        with pytest.raises(ValueError, match=message):
            read_barn(path)
    path.write_bytes(b"PK nothing")
    with pytest.raises(ValueError, match="is damaged"):
        read_barn(path)
