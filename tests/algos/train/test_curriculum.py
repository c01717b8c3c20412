"""A curriculum counts attempts, changes the weights of the worlds and records what it did."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv, Terrain, World, box
from rover_rl.algos.config import training_config, with_settings
from rover_rl.algos.train import train
from rover_rl.algos.train.curriculum import Curriculum
from rover_rl.algos.train.run_folder import load_state
from rover_rl.envs.config import TaskConfig
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.sims.worlds.pool import WorldPool
from tests.algos.train.runs import LEARNABLE, equal, progress_of

WALLS = [World(f"wall {k}", Terrain.flat((8.0, 8.0)), [box((2.0, 0.0, 0.5), (0.2, 1.0 + k, 1.0))]) for k in range(3)]


def make(rows: int, length: int = 40, estimates: dict[str, Tensor] | None = None, **settings) -> EnvBase:
    task = TaskConfig(collision_from="contact", collision_window=0)
    pool = WorldPool(*WALLS)
    env = RoverEnv(world_n=pool, num_envs=rows, seed=0, backend="warp", length=length, task=task, **settings)
    return env.append_transform(ActionRepeat(4)).append_transform(Curriculum(env, 1.0, 0.25, estimates))


def drive(env: EnvBase, goals: list[list[float]], speeds: list[float]) -> list[TensorDictBase]:
    """Decisions of rovers that drive along x from the origin, until the first episode ends."""
    td = env.reset(start=torch.zeros(len(goals), 3), goal=torch.tensor(goals))
    steps = []
    while not steps or not steps[-1]["done"].any():
        td = env.step(td.set("action", torch.tensor([[speed, 0.0] for speed in speeds])))
        steps.append(td["next"])
        td = env.step_mdp(td)
    return steps


def total(steps: list[TensorDictBase], name: str) -> list[int]:
    return torch.stack([step["attempt", name] for step in steps]).sum(0).flatten().tolist()


def test_the_environment_matches_its_specs() -> None:
    check_env_specs(make(3))


def test_a_goal_is_a_success_and_a_touch_a_failure() -> None:
    steps = drive(make(2, length=2000), [[1.2, 0.0], [3.5, 0.0]], [1.0, 1.0])
    assert steps[-1]["terminated"].all()
    # The first rover reaches a goal before the wall, and touches the wall on the way to the next one.
    assert total(steps, "succeeded") == [1, 0]
    assert total(steps, "failed") == [1, 1]


def test_a_goal_that_ends_the_episode_is_no_failure() -> None:
    steps = drive(make(1, length=2000, end_on_goal=True), [[1.2, 0.0]], [1.0])
    assert (total(steps, "succeeded"), total(steps, "failed")) == ([1], [0])


def test_the_time_limit_fails_attempts_of_at_least_half_the_episode() -> None:
    steps = drive(make(2, length=40), [[1.2, 0.0], [3.5, 0.0]], [0.5, 0.0])
    assert steps[-1]["truncated"].all()
    begun = steps[-1]["attempt", "begun"].flatten().tolist()
    # The first rover has reached a goal at 0.7 m, after more than half the time.
    assert 20 < begun[0] < 40
    assert begun[1] == 0
    assert total(steps, "succeeded") == [1, 0]
    assert total(steps, "failed") == [0, 1]


def test_episodes_follow_the_success_of_the_policy() -> None:
    """Rovers that reached every other goal in the first world, and then none, move on to the third one."""
    successes = torch.tensor([50.0, 0.0, 97.0], dtype=torch.float64)
    estimates = {"attempts": torch.full((3,), 100.0, dtype=torch.float64), "successes": successes}
    env = make(64, length=4, estimates=estimates)
    td, shares = env.reset(), []
    for _ in range(25):
        # Each decision is an episode in which the rovers stand still.
        step, td = env.step_and_maybe_reset(td.set("action", torch.zeros(64, 2)))
        shares.append(step["next", "outcome", "world"].flatten().bincount(minlength=3) / 64)
    # The first episodes have drawn their worlds before these had weights.
    assert shares[0].max() < 0.6
    assert shares[1][0] > 0.9
    assert shares[1][2] < 0.1
    assert max(share[2] for share in shares) > 0.9


def test_estimates_may_learn_from_whole_batches() -> None:
    pool = WorldPool(*WALLS)
    base = RoverEnv(world_n=pool, num_envs=8, seed=0, backend="warp", length=8)
    curriculum = Curriculum(base, 1.0, 0.25, per_batch=True)
    env = base.append_transform(ActionRepeat(4)).append_transform(curriculum)
    batch = env.rollout(6, break_when_any_done=False)
    assert not curriculum.learnability.attempts.any()
    curriculum.batch_collected(batch)
    attempts = batch["next", "attempt", "succeeded"] + batch["next", "attempt", "failed"]
    counts = batch["next", "outcome", "world"].flatten().bincount(attempts.flatten(), minlength=3)
    assert counts.sum() > 0
    assert torch.equal(curriculum.learnability.attempts, counts)


def test_a_run_records_its_worlds_and_continues_with_its_estimates(tmp_path: Path) -> None:
    first = train(with_settings(LEARNABLE, total_steps=512, runs=str(tmp_path)))
    progress, rows = progress_of(first.folder), _record(first.folder)
    assert len(progress["drawn_learnability"]) == len(progress["steps"])
    assert 0 < progress["drawn_learnability"][0] <= 0.25
    assert 0 <= progress["drawn_difficulty"][0] <= 1
    draws = [int(row["draws"]) for row in rows]
    assert draws == sorted(draws, reverse=True)
    # The first episodes of the rovers, and those after each end but the last.
    assert 4 <= sum(draws) <= 4 + sum(progress["episodes"])
    assert sum(int(row["attempts"]) for row in rows) > 0
    assert sum(int(row["successes"]) for row in rows) == sum(progress["goals_per_2000_steps"]) * 64 / 2000
    for row in rows:
        assert row["world"].startswith("maze:")
        rate = float(row["success_rate"])
        assert float(row["learnability"]) == pytest.approx(rate * (1 - rate), abs=1e-4)
    state = load_state(first.folder / "training_state.pt")["curriculum"]
    second = train(with_settings(LEARNABLE, total_steps=640, runs=str(tmp_path)), first.folder)
    again = load_state(second.folder / "training_state.pt")["curriculum"]
    assert (again["totals"] >= state["totals"]).all()
    assert again["totals"].sum() > state["totals"].sum()
    assert sum(int(row["draws"]) for row in _record(second.folder)) >= sum(draws) + 4


def _record(folder: Path) -> list[dict[str, str]]:
    with (folder / "curriculum.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_the_same_seed_draws_the_same_worlds(tmp_path: Path) -> None:
    summaries = [train(with_settings(LEARNABLE, runs=str(tmp_path / name))) for name in "ab"]
    states = [load_state(summary.folder / "training_state.pt") for summary in summaries]
    assert equal(states[0]["curriculum"], states[1]["curriculum"])
    assert equal(states[0]["learner"], states[1]["learner"])


@pytest.mark.slow
@pytest.mark.usefixtures("quick_workers")
def test_workers_have_a_curriculum_of_their_own(tmp_path: Path) -> None:
    config = with_settings(LEARNABLE, workers=2, total_steps=512, runs=str(tmp_path))
    folder = train(config).folder
    assert train(with_settings(config, total_steps=768), folder).steps == 768
    assert sum(int(row["draws"]) for row in _record(folder)) >= 8


def test_a_range_of_one_world_leaves_nothing_to_choose(tmp_path: Path) -> None:
    folder = train(with_settings(LEARNABLE, world="maze:7-7", total_steps=128, runs=str(tmp_path))).folder
    assert [row["world"] for row in _record(folder)] == ["maze:7"]


def test_a_curriculum_needs_worlds_to_choose_from(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="curriculum chooses among the worlds of a range"):
        train(with_settings(LEARNABLE, world="maze", runs=str(tmp_path)))
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match="curriculum needs backend='warp'"):
        training_config("ppo", curriculum="learnability", backend="bullet").check()
