"""A curriculum counts attempts, changes the weights of the worlds and records what it did."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl import RoverEnv, Terrain, World, box
from rover_rl.algos.train.curriculum import Curriculum, Learnability
from rover_rl.envs.config import TaskConfig
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.worlds.pool import WorldPool
from tests.algos.train.runs import LEARNABLE, progress_of, record_of, run, state_of

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


def test_a_goal_is_a_success_and_a_touch_a_failure() -> None:
    steps = drive(make(2, length=2000), [[1.2, 0.0], [3.5, 0.0]], [1.0, 1.0])
    assert steps[-1]["terminated"].all()
    # The first rover reaches a goal before the wall, and touches the wall on the way to the next one.
    assert total(steps, "succeeded") == [1, 0]
    assert total(steps, "failed") == [1, 1]


def test_the_time_limit_fails_attempts_of_at_least_half_the_episode() -> None:
    steps = drive(make(2, length=40), [[1.2, 0.0], [3.5, 0.0]], [0.5, 0.0])
    assert steps[-1]["truncated"].all()
    # The first rover has reached a goal at 0.7 m, after more than half the time.
    first, second = steps[-1]["attempt", "begun"].flatten().tolist()
    assert 20 < first < 40
    assert second == 0
    assert (total(steps, "succeeded"), total(steps, "failed")) == ([1, 0], [0, 1])


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
    base = RoverEnv(world_n=WorldPool(*WALLS), num_envs=8, seed=0, backend="warp", length=8)
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
    folder = run(LEARNABLE, tmp_path, total_steps=512).folder
    progress, rows = progress_of(folder), record_of(folder)
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
    before = state_of(folder)["curriculum"]["totals"]
    run(LEARNABLE, tmp_path, folder, total_steps=640)
    again = state_of(folder)["curriculum"]["totals"]
    assert (again >= before).all()
    assert sum(int(row["draws"]) for row in record_of(folder)) >= sum(draws) + 4


# --- learnability


def attempt(learnability: Learnability, world: int, successes: int, failures: int) -> None:
    learnability.add(torch.tensor([world]), torch.tensor([successes]), torch.tensor([failures]))


def test_many_attempts_in_a_world_decide_its_rate_and_few_that_of_its_group() -> None:
    learnability = Learnability(WorldPool("maze:0-9@0.2", "maze:0-9@0.8", "moon:0-9"))
    attempt(learnability, 0, 90, 10)
    attempt(learnability, 10, 2, 98)
    rates = learnability.success_rate
    assert rates[0] == pytest.approx(0.9, abs=0.03)
    assert rates[1:10].tolist() == pytest.approx([0.9] * 9, abs=0.03)
    assert rates[10:20].tolist() == pytest.approx([0.02] * 10, abs=0.03)
    # Nothing is known of the moon, except for the mean of all worlds.
    assert rates[20:].tolist() == pytest.approx([0.46] * 10, abs=0.02)
    torch.testing.assert_close(learnability.values, rates * (1 - rates))


def test_attempts_are_forgotten() -> None:
    learnability = Learnability(WorldPool("maze:0-1"))
    attempt(learnability, 0, 0, 200)
    before = learnability.attempts[0].item()
    attempt(learnability, 1, 1_000, 1_000)
    assert learnability.attempts[0].item() == pytest.approx(before / 2)
    attempt(learnability, 0, 800, 0)
    assert learnability.success_rate[0] > 0.85


def test_draws_prefer_worlds_of_half_the_attempts_and_a_share_stays_even() -> None:
    unknown = Learnability(WorldPool("maze:0-3", "moon")).probabilities(0.5, 0.25)
    assert unknown.tolist() == pytest.approx([0.125] * 4 + [0.5])
    learnability = Learnability(WorldPool("maze:0-2"))
    for world, successes in enumerate((2, 50, 97)):
        attempt(learnability, world, successes, 100 - successes)
    even, mixed, sharp = (learnability.probabilities(*each) for each in ((0.0, 0.25), (0.4, 0.25), (1.0, 0.02)))
    assert even.tolist() == pytest.approx([1 / 3] * 3)
    for probabilities in (mixed, sharp):
        assert probabilities.sum().item() == pytest.approx(1)
    assert mixed.min() >= 0.6 / 3
    assert mixed[1] > 0.59
    assert sharp[1] > 0.999
