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
from benchmarks.digests import stored_policies, stored_worlds
from benchmarks.law import quantities
from benchmarks.options import Options
from benchmarks.plain_rover import PlainRover
from benchmarks.ratios import paired, told
from rover_rl import RoverEnv
from rover_rl.algos.config import with_settings
from rover_rl.algos.policy.networks import ObservationEncoder, make_action_critic, make_actor, make_critic
from rover_rl.algos.pretrained import pretrained_names
from rover_rl.envs.config import EnvConfig
from tests.fork_server import quick_workers

Bench = Callable[..., dict[str, Any]]
SMALL = [
    *("--num-envs", "1", "2", "--beams", "32", "--rovers", "2", "--processes", "1"),
    *("--warp-rovers", "16", "--warp-envs", "16"),
    *("--seconds", "0.05", "--rounds", "1", "--minutes", "0.005", "--world", "maze"),
]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Runs a part of ``python -m benchmarks`` in this process, and returns what it has written."""
    threads = torch.get_num_threads()

    def run(part: str, *options: str, workers: int = 1) -> Any:
        given = [part, *SMALL, "--workers", str(workers), *options, "--out", str(tmp_path)]
        monkeypatch.setattr(sys, "argv", ["benchmarks", *given])
        runpy.run_module("benchmarks", run_name="__main__", alter_sys=True)
        return json.loads((tmp_path / "bench.json").read_text())[part]

    with quick_workers():
        yield run
    torch.set_num_threads(threads)


def test_rollouts(bench: Bench) -> None:
    rows = bench("rollouts")
    assert [row["num_envs"] for row in rows] == [1, 2]
    assert all(row["physics"] > 0 and row["rays"] > 0 and row["rest"] > 0 for row in rows)


def test_warp_beside_bullet(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(simulators, "WORLDS", ("maze",))
    ratios = bench("simulators", "--engines", "warp")["ratios"]
    assert len(ratios) == 2 + 1 + 3 + 1
    assert all(row["median"] > 0 for row in ratios)


def test_simulators_are_compared_with_the_law(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    # Of each ground the first: tests/sims/test_law.py has all slopes, commands and grounds.
    kinds = {quantity.ground: quantity for quantity in reversed(quantities())}
    monkeypatch.setattr(law, "quantities", lambda: [kinds["plane"], kinds["slope"]])
    rows = bench("law", "--engines", "warp")
    assert [row["ground"] for row in rows] == ["plane", "slope"]
    for found in (row["engines"]["warp"] for row in rows):
        assert found["passes"]
        assert found["least"] <= found["mean"] <= found["greatest"]


@pytest.mark.slow
def test_peers_beside_two_workers(bench: Bench) -> None:
    rows = bench("peers", workers=2)
    assert len({row["peer"] for row in rows}) == 3
    assert all(row["rate"] > 0 and row["other"] > 0 for row in rows)


def test_lines_tell_what_is_measured_and_what_was_found(capsys: pytest.CaptureFixture[str]) -> None:
    def measure() -> dict[str, Any]:
        assert capsys.readouterr().out == "64 rovers ...\n"
        return {"rovers": 64, "world": "maze", "rate": 1234.56, "other": None}

    assert told("64 rovers", measure)["world"] == "maze"
    assert capsys.readouterr().out.startswith("64 rovers: rovers 64, rate 1,235, took ")
    told("maze", lambda: paired(lambda: 1, lambda: 1, 0.001, 1))
    assert "\nmaze: rate " in capsys.readouterr().out


def test_a_wrong_engine_fails_the_law() -> None:
    quantity = next(quantity for quantity in quantities() if quantity.unit == "rad/s")
    wrong = replace(quantity, measure=lambda _: torch.full((16,), 1.06 * quantity.law)).compare("any")
    assert wrong["worst_error"] == pytest.approx(0.06, abs=1e-6)
    assert not wrong["passes"]
    lone = torch.full((16,), quantity.law)
    lone[7] *= 0.94
    assert not replace(quantity, measure=lambda _: lone).compare("any")["passes"]
    degrees = replace(quantity, unit="deg", law=26.6, measure=lambda _: torch.full((16,), 25.7)).compare("any")
    assert degrees["passes"]
    assert degrees["worst_error"] == pytest.approx(-0.9, abs=1e-4)


def test_the_plain_rover_drives_as_ours_does() -> None:
    plain, ours = PlainRover("maze"), RoverEnv(world_n="maze", seed=0)
    check_env(plain, skip_render_check=True)
    plain = PlainRover("maze")
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


def test_policies_belong_to_stored_worlds() -> None:
    assert stored_worlds(EnvConfig(world=("maze:0-99@0.2-0.8", "rooms:0-99", "moon", "maze:*"))) == ["maze", "moon"]
    # A world with a seed is another one than the stored one.
    assert stored_worlds(EnvConfig(world="maze:7")) == []
    assert {*pretrained_names()} - {*stored_policies()} == {"hills"}


# --- SB3 is given networks, inputs and settings of ours, so that the speeds of training compare


def test_sb3_gets_networks_and_inputs_of_ours(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    from benchmarks import training
    from rover_rl.envs.sb3 import SB3VecEnv

    def count(*modules: torch.nn.Module) -> int:
        return sum(parameter.numel() for module in modules for parameter in module.parameters())

    models, hidden = {}, (24, 16)
    for algo in ("ppo", "sac"):
        config = training.make_config(Options(rovers=2, workers=2, world="maze"), algo, tmp_path)
        config = with_settings(config, workers=1, hidden=hidden, minibatch=32)
        models[algo] = training.make_sb3(config, SB3VecEnv(training.rovers_for_sb3(config)))
    sac, ppo = models["sac"], models["ppo"]
    actor, encoder = count(make_actor(hidden=hidden)), ObservationEncoder()
    assert count(sac.actor) == actor
    assert count(sac.critic) == 2 * count(make_action_critic(encoder, hidden))
    value = count(make_critic(hidden=hidden))
    assert count(ppo.policy.mlp_extractor.value_net, ppo.policy.value_net) == value
    # PPO's standard deviation is one number for each action instead of an output of the network.
    assert count(ppo.policy.mlp_extractor.policy_net, ppo.policy.action_net) == actor - (16 * 2 + 2)
    observation = {key: torch.as_tensor(value) for key, value in ppo.env.reset().items()}
    expected = encoder(*(observation[key] for key in encoder.keys))
    for owner in (sac.actor, sac.critic, ppo.policy):
        assert torch.equal(owner.extract_features(observation, owner.features_extractor), expected)


@pytest.mark.slow
def test_ppo_trains_in_all_three(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    from benchmarks import training

    options = Options(rovers=1, workers=1, world="maze", minutes=0.001)
    with quick_workers():
        for name, contender in training.CONTENDERS.items():
            assert contender(training.make_config(options, "ppo", tmp_path / name)) > 0
