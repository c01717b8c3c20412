"""The policies of the package reach their goals, and their cards tell how they were trained."""

from __future__ import annotations

import re
import shlex
from dataclasses import replace

import pytest
import tyro

from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.pretrained import FOLDER, load_pretrained, pretrained_names
from rover_rl.cli.train import train_defaults
from rover_rl.envs.imperfections import imperfect

WORLDS = {
    "anyrobot": ("maze:10000-10007", 0.75),
    "anywhere": ("maze:10000-10007", 0.85),
    "crowd": ("field:10000-10007@0.25", 0.75),
    "hills": ("hills:10000-10007", 0.85),
    "moon-depth": ("moon:10000-10007", 0.85),
    "moon-ppo": ("moon:10000-10007", 0.85),
    "moon-sac": ("moon:10000-10007", 0.85),
    "race": ("forest:10000-10007", 0.75),
    "robust": ("maze:10000-10007", 0.85),
}
"""Unseen worlds, and the share of the episodes that a policy must reach in them; its card tells what it reaches."""


def test_each_has_a_card_with_the_command_that_trained_it() -> None:
    assert pretrained_names() == [*WORLDS]
    for name in pretrained_names():
        assert (FOLDER / f"{name}.pt").stat().st_size < 1_500_000
        card = (FOLDER / f"{name}.md").read_text()
        assert all(told in card for told in ("seed", "steps", "minutes", "SPL", "rover-rl evaluate"))
        command = re.search(r"^    rover-rl train ((?:.*\\\n)*.*)$", card, re.MULTILINE)
        assert command is not None
        arguments = shlex.split(command[1].replace("\\\n", " "))
        defaults = train_defaults(["train", *arguments])
        told = tyro.cli(type(defaults), args=arguments, default=defaults)
        assert told.config == load_pretrained(name).config


@pytest.mark.slow
@pytest.mark.parametrize("name", WORLDS)
def test_it_reaches_goals_in_worlds_that_it_has_not_seen(name: str) -> None:
    world, least = WORLDS[name]
    actor = load_pretrained(name).make_actor()
    env = replace(actor.made_for, backend="warp", world=world)
    if name == "robust":
        env = imperfect(env, "all")
        assert env.compensate_delay
    env = replace(env, robot="any:10000-10003").fitted() if name == "anyrobot" else env
    episodes = draw_episodes(env.world, count=1, robot=env.robot)
    assert evaluate(actor, episodes, env=env, rows=8, seconds=60).success_rate >= least


def test_a_name_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match=r"no pretrained policy 'mars-ppo', perhaps 'moon-ppo'; use one of \["):
        load_pretrained("mars-ppo")
