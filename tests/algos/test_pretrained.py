from __future__ import annotations

import math
import re
import shlex
from dataclasses import replace

import pytest
import tyro

from rover_rl.algos.evaluation.episodes import draw_episodes, stored_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.pretrained import FOLDER, load_pretrained, pretrained_names
from rover_rl.cli.train import train_defaults
from rover_rl.envs import imperfect
from rover_rl.robots import get_robot

FLOOR = {"inspect": 0.9, "moon": 0.9}
"""Share of the episodes below that a policy must reach in a world; its card tells what it reaches of all of them."""
ANYWHERE = "anywhere"
"""Name of the policy for all worlds."""
ANYROBOT = "anyrobot"
"""Name of the policy for all robots."""
CROWD = "crowd"
"""Name of the policy for worlds in which something moves."""
DEPTH = "moon-depth"
"""Name of the policy with a depth camera."""
FRONT = "front-lidar"
"""Name of the policy for a lidar that sees half a turn."""
HEIGHTS = "hills-heights"
"""Name of the policy with a height scan."""
ROBUST = "robust"
"""Name of the policy for real sensors."""


def test_there_is_one_for_each_use_and_one_of_each_algorithm_with_a_card() -> None:
    assert pretrained_names() == [ANYROBOT, ANYWHERE, CROWD, FRONT, HEIGHTS, DEPTH, "moon-ppo", "moon-sac", ROBUST]
    for name in pretrained_names():
        assert (FOLDER / f"{name}.pt").stat().st_size < 1_500_000
        card = (FOLDER / f"{name}.md").read_text()
        for told in ("rover-rl train", "seed", "steps", "minutes", "SPL", "rover-rl evaluate"):
            assert told in card


@pytest.mark.parametrize("name", pretrained_names())
def test_its_card_tells_the_command_that_trained_it(name: str) -> None:
    card = (FOLDER / f"{name}.md").read_text()
    command = re.search(r"^    rover-rl train ((?:.*\\\n)*.*)$", card, re.MULTILINE)
    assert command is not None
    arguments = shlex.split(command[1].replace("\\\n", " "))
    defaults = train_defaults(["train", *arguments])
    told = tyro.cli(type(defaults), args=arguments, default=defaults)
    assert told.config == load_pretrained(name).config


@pytest.mark.slow
@pytest.mark.parametrize("name", ["moon-ppo", "moon-sac"])
def test_it_reaches_its_goals(name: str) -> None:
    checkpoint = load_pretrained(name)
    world = checkpoint.env.world
    assert f"{world}-{checkpoint.config.algo}" == name
    actor, episodes = checkpoint.make_actor(), stored_episodes(world).first(12)
    env = replace(actor.made_for, backend="warp")
    assert evaluate(actor, episodes, env=env, seconds=40, rows=12).success_rate >= FLOOR[world]


@pytest.mark.slow
@pytest.mark.parametrize("world", FLOOR)
def test_the_one_for_all_reaches_its_goals_in_each_world(world: str) -> None:
    actor, episodes = load_pretrained(ANYWHERE).make_actor(), stored_episodes(world).first(12)
    env = replace(actor.made_for, backend="warp")
    assert evaluate(actor, episodes, env=env, seconds=40, rows=12).success_rate >= FLOOR[world]


@pytest.mark.slow
def test_the_one_for_all_reaches_goals_in_mazes_that_it_has_not_seen() -> None:
    actor, episodes = load_pretrained(ANYWHERE).make_actor(), draw_episodes("maze:10000-10015", episodes=1)
    result = evaluate(actor, episodes, env=replace(actor.made_for, backend="warp"), rows=16)
    assert result.success_rate >= 0.9


@pytest.mark.slow
def test_the_one_for_all_robots_reaches_goals_with_robots_that_it_has_not_seen() -> None:
    actor = load_pretrained(ANYROBOT).make_actor()
    env = replace(actor.made_for, backend="warp", robot="any:10000-10003", world="maze:10000-10003").fitted()
    result = evaluate(actor, draw_episodes(env.world, episodes=2, robot=env.robot), env=env, seconds=90, rows=8)
    assert result.success_rate >= 0.75


@pytest.mark.slow
def test_the_one_for_moving_worlds_reaches_its_goals_among_what_moves() -> None:
    actor, episodes = load_pretrained(CROWD).make_actor(), draw_episodes("field:10000-10007@0.25", episodes=1)
    result = evaluate(actor, episodes, env=replace(actor.made_for, backend="warp"), rows=8)
    assert result.success_rate >= 0.75


@pytest.mark.slow
def test_the_one_for_real_rovers_reaches_goals_with_late_and_noisy_sensors() -> None:
    actor, episodes = load_pretrained(ROBUST).make_actor(), draw_episodes("maze:10000-10015", episodes=1)
    env = imperfect(replace(actor.made_for, backend="warp"), "all")
    assert env.compensate_delay
    assert env.limits.apply
    assert evaluate(actor, episodes, env=env, rows=16).success_rate >= 0.85


@pytest.mark.slow
def test_the_one_for_a_front_lidar_reaches_its_goals_with_it() -> None:
    actor, episodes = load_pretrained(FRONT).make_actor(), draw_episodes("maze:10000-10015", episodes=1)
    env = replace(actor.made_for, backend="warp")
    assert get_robot(env.robot).lidar_view == pytest.approx(math.pi, abs=0.01)
    assert evaluate(actor, episodes, env=env, rows=16).success_rate >= 0.9


@pytest.mark.slow
def test_the_one_with_a_height_scan_reaches_its_goals_in_hills_that_it_has_not_seen() -> None:
    actor, episodes = load_pretrained(HEIGHTS).make_actor(), draw_episodes("hills:10000-10007", episodes=1)
    assert "heights" in actor.in_keys
    assert evaluate(actor, episodes, env=replace(actor.made_for, backend="warp"), rows=8).success_rate >= 0.85


@pytest.mark.slow
def test_the_one_with_a_depth_camera_reaches_its_goals_in_moons_that_it_has_not_seen() -> None:
    actor, episodes = load_pretrained(DEPTH).make_actor(), draw_episodes("moon:10000-10007", episodes=2)
    assert "lidar" not in actor.in_keys
    result = evaluate(actor, episodes, env=replace(actor.made_for, backend="warp"), rows=16)
    assert result.success_rate >= 0.85


def test_a_name_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no pretrained policy 'mars-ppo', perhaps 'moon-ppo'; use one of \["):
        load_pretrained("mars-ppo")
