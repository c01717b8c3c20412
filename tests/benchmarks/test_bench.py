"""``python -m benchmarks``: every part runs, at its smallest, and tells what it measured."""

from __future__ import annotations

import json
import runpy
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from benchmarks import law, simulators
from benchmarks.law import quantities
from benchmarks.options import Options
from benchmarks.plain_rover import PlainRover
from benchmarks.ratios import paired, told
from rover_rl import RoverEnv
from tests.fork_server import quick_workers

Bench = Callable[..., dict[str, Any]]
SMALL = [
    *("--num-envs", "1", "2", "--beams", "32", "--rovers", "2", "--workers", "2", "--processes", "2"),
    *("--warp-rovers", "16", "--warp-envs", "16"),
    *("--seconds", "0.05", "--rounds", "1", "--minutes", "0.005", "--world", "maze"),
]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Runs parts of ``python -m benchmarks`` in this process, and returns what they have written."""
    threads = torch.get_num_threads()

    def run(*parts: str) -> dict[str, Any]:
        monkeypatch.setattr(sys, "argv", ["benchmarks", *parts, *SMALL, "--out", str(tmp_path)])
        runpy.run_module("benchmarks", run_name="__main__", alter_sys=True)
        return json.loads((tmp_path / "bench.json").read_text())

    with quick_workers():
        yield run
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_rollouts(bench: Bench) -> None:
    rows = bench("rollouts")["rollouts"]
    assert [row["num_envs"] for row in rows] == [1, 2]
    assert all(row["physics"] > 0 and row["rays"] > 0 and row["rest"] > 0 for row in rows)
    assert [row["all_workers"] is None for row in rows] == [True, False]


@pytest.mark.slow
def test_warp_beside_bullet(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    # Bullet takes a second to prepare the ground of inspect and moon.
    monkeypatch.setattr(simulators, "WORLDS", ("maze", "maze:1", "maze:2"))
    results = bench("simulators", "--engines", "warp")
    ratios = results["simulators"]["ratios"]
    assert len(ratios) == 3 * 2 + 3 + 1
    assert all(row["median"] > 0 for row in ratios)


@pytest.mark.slow
def test_simulators_are_compared_with_the_law(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    # Of each kind the first: tests/sims/test_law.py has all slopes, commands and grounds.
    kinds = {quantity.measure.__qualname__: quantity for quantity in reversed(quantities())}
    monkeypatch.setattr(law, "quantities", lambda: [*kinds.values()])
    rows = bench("law", "--engines", "warp")["law"]
    assert len(rows) >= 9
    assert {row["ground"] for row in rows} == {"plane", "slope"}
    assert all(row["engines"]["warp"]["passes"] for row in rows)
    for row in rows:
        found = row["engines"]["warp"]
        assert found["least"] <= found["mean"] <= found["greatest"]


def test_lines_tell_what_is_measured_and_what_was_found(capsys: pytest.CaptureFixture[str]) -> None:
    def measure() -> dict[str, Any]:
        assert capsys.readouterr().out == "64 rovers ...\n"
        return {"rovers": 64, "world": "maze", "rate": 1234.56, "other": None}

    assert told("64 rovers", measure)["world"] == "maze"
    assert capsys.readouterr().out.startswith("64 rovers: rovers 64, rate 1,235, took ")
    told("maze", lambda: paired(lambda: 1, lambda: 1, 0.001, 1))
    assert "\nmaze: rate " in capsys.readouterr().out
    told("part", lambda: [1, 2])
    assert "\npart: took " in capsys.readouterr().out


def test_a_wrong_engine_fails_the_law() -> None:
    quantity = next(quantity for quantity in quantities() if quantity.unit == "rad/s")
    wrong = replace(quantity, measure=lambda _: torch.full((16,), 1.06 * quantity.law))
    assert wrong.compare("any")["worst_error"] == pytest.approx(0.06, abs=1e-6)
    assert not wrong.compare("any")["passes"]
    lone = torch.full((16,), quantity.law)
    lone[7] *= 0.94
    assert not replace(quantity, measure=lambda _: lone).compare("any")["passes"]
    degrees = replace(quantity, unit="deg", law=26.6, measure=lambda _: torch.full((16,), 25.7))
    assert degrees.compare("any")["passes"]
    assert degrees.compare("any")["worst_error"] == pytest.approx(-0.9, abs=1e-4)


@pytest.mark.slow
def test_peers(bench: Bench) -> None:
    rows = bench("peers")["peers"]
    assert len({row["peer"] for row in rows}) == 3
    assert all(row["rate"] > 0 and row["other"] > 0 for row in rows)


def test_the_plain_rover_is_a_gymnasium_environment() -> None:
    env = PlainRover("maze")
    check_env(env, skip_render_check=True)
    env.close()


def test_the_plain_rover_drives_as_ours_does() -> None:
    plain, ours = PlainRover("maze"), RoverEnv(world_n="maze", seed=0)
    plain.reset(seed=0)
    start = torch.tensor([[-3.0, 0.0, 0.5]])
    td = ours.reset(start=start, goal=torch.tensor([[-3.0, 3.0]]))
    plain.place(*start[0].tolist())
    action = np.array([0.8, 0.3], np.float32)
    for _ in range(20):
        seen = plain.step(action)[0]
        td = ours.step(td.set("action", torch.from_numpy(action)[None]))["next"]
    np.testing.assert_allclose(seen["imu"], td["imu"][0], atol=0.03)
    np.testing.assert_allclose(seen["velocities"], td["velocities"][0], atol=0.03)
    np.testing.assert_allclose(seen["lidar"], td["lidar"][0], atol=0.3)


@pytest.mark.parametrize(
    ("setting", "value"), [("rovers", 0), ("rovers", 3), ("beams", (16,)), ("num_envs", ()), ("rounds", 0)]
)
def test_settings_out_of_range_are_refused(setting: str, value: object) -> None:
    with pytest.raises(ValueError, match=setting):
        Options(**{"workers": 2, setting: value})
