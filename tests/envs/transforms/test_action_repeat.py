from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from rover_rl import TaskConfig, World, make_env
from rover_rl.envs.config import Randomization
from rover_rl.envs.rewards import RewardComponent
from rover_rl.envs.task import StepEvent
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.worlds import Terrain
from tests.extras import needs_mujoco

FIELD = World("field", Terrain.flat((12.0, 12.0)), bounds=((-5.0, 5.0), (-5.0, 5.0)))
START = torch.tensor([[0.0, 0.0, 0.0], [4.8, 2.0, 0.0], [0.0, -2.0, 0.0]])
GOAL = torch.tensor([[0.6, 0.0], [0.0, 2.0], [4.0, -2.0]])
"""Row 0 soon reaches its goal, row 1 soon leaves the bounds, row 2 drives on."""
FORWARD = torch.tensor([[1.0, 0.0], [1.0, 0.0], [1.0, 0.2]])


def field(repeat: int | None = None, **kwargs: object) -> EnvBase:
    env = make_env(world_n=FIELD, num_envs=3, seed=0, **kwargs)
    return env if repeat is None else env.append_transform(ActionRepeat(repeat))


def decide(env: EnvBase, td: TensorDict, **entries: torch.Tensor) -> TensorDict:
    return env.step(td.clone().update({"action": FORWARD, **entries}))["next"]


def decisions(repeat: int, count: int, **kwargs: object) -> Iterator[tuple[TensorDict, list[TensorDict]]]:
    """Decisions of the repeated environment, each beside the single steps that it stands for."""
    single, repeated = field(**kwargs), field(repeat, **kwargs)
    td, one = repeated.reset(start=START, goal=GOAL), single.reset(start=START, goal=GOAL)
    for _ in range(count):
        steps = []
        for _ in range(repeat):
            one = decide(single, one)
            steps.append(one)
        td = decide(repeated, td)
        yield td, steps
        if td["done"].any():
            return


def taken(steps: list[TensorDict]) -> torch.Tensor:
    """Which rows were still running before each of the steps: bool ``[steps, N, 1]``."""
    done = torch.stack([step["done"] for step in steps]).cumsum(0).bool()
    return torch.cat((torch.ones_like(done[:1]), ~done[:-1]))


@pytest.mark.parametrize("end_on_goal", [False, True])
def test_rewards_and_components_are_summed_until_the_ending(end_on_goal: bool) -> None:
    for td, steps in decisions(8, 5, end_on_goal=end_on_goal):
        active = taken(steps)
        for key in ("reward", *(("reward_components", name) for name in td["reward_components"].sorted_keys)):
            expected = (torch.stack([step[key] for step in steps]) * active).sum(0)
            torch.testing.assert_close(td[key], expected, msg=str(key))
    assert td["done"].any()


def test_outcome_tells_of_the_whole_decision() -> None:
    goals = 0
    for td, steps in decisions(8, 5):
        active = taken(steps)
        outcome, singles = td["outcome"], torch.stack([step["outcome"] for step in steps])
        assert torch.equal(outcome["goals"], (singles["goal_reached"] & active).sum(0))
        assert torch.equal(outcome["goal_reached"], outcome["goals"] > 0)
        assert torch.equal(outcome["phase"], singles["phase"].masked_fill(~active, StepEvent.NONE).amin(0))
        torch.testing.assert_close(outcome["progress"], (singles["progress"] * active).sum(0))
        goals += int(outcome["goals"].sum())
    assert goals == 1
    assert outcome["out_of_bounds"][1].item()


def test_rows_held_by_the_caller_stand_still() -> None:
    env = field(4)
    first = decide(env, env.reset(start=START, goal=GOAL))
    second = decide(env, first, _step=torch.tensor([True, False, True]))
    assert torch.equal(second["pose"][1], first["pose"][1])
    assert second["reward"][1] == 0
    assert second["outcome", "phase"][1] == StepEvent.NONE
    assert second["outcome", "steps"].squeeze(-1).tolist() == [8, 4, 8]


def test_several_goals_in_one_decision_all_count() -> None:
    env = field(4, task=TaskConfig(success_distance=40.0))
    td = decide(env, env.reset(start=START, goal=GOAL))
    assert (td["outcome", "goals"] == 4).all()
    assert (td["reward_components", "goal"] == 400).all()


CONTACTS = TaskConfig(collision_from="contact", collision_window=0)


@pytest.mark.parametrize("rows", [1, 6])
@pytest.mark.parametrize(
    "settings",
    [
        {"backend": "warp", "physics": "planar"},
        {"backend": "warp", "world": "plaza:3"},
        {"backend": "warp", "world": "field:3", "sensors": ("past_scans(period=4, apart=4)",), "privileged": True},
        {"backend": "bullet"},
        pytest.param({"backend": "mujoco"}, marks=needs_mujoco),
    ],
    ids=lambda settings: "-".join(map(str, settings.values())),
)
def test_a_decision_scans_once_and_observes_what_its_last_step_does(settings: dict[str, Any], rows: int) -> None:
    single, repeated = (
        make_env(num_envs=rows, seed=3, length=41, task=CONTACTS, **{"world": "maze", **settings}) for _ in range(2)
    )
    scans, scan = [], repeated.scanner.scan
    repeated.scanner.scan = lambda chosen: scans.append(chosen) or scan(chosen)
    repeated.append_transform(ActionRepeat(4))
    td, one, decided = repeated.reset(), single.reset(), 0
    generator = torch.Generator().manual_seed(0)
    while not td["done"].all():
        action = torch.rand(rows, 2, generator=generator) + torch.tensor([0.2, -0.5])
        active = ~td["done"].squeeze(-1)
        td, decided = repeated.step(td.update({"action": action, "_step": active}))["next"], decided + 1
        for _ in range(4):
            one = single.step(one.update({"action": action, "_step": active}))["next"]
            active = active & ~one["done"].squeeze(-1)
        for key in [*repeated.observation_spec.keys(True, True), "done", "terminated", "truncated"]:
            if "outcome" not in key or "steps" in key:
                assert torch.equal(td[key], one[key]), key
    assert len(scans) == decided + 1, "one after the reset, and one for each decision"
    assert (td["outcome", "steps"] % 4 != 0).any(), "some episodes end within a decision"


class Clearance(RewardComponent):
    name = "clearance"

    def value(self, outcome: TensorDict, observation: TensorDict) -> torch.Tensor:
        return observation["lidar"].amin(-1, keepdim=True)


@pytest.mark.parametrize("settings", [{"reward": Clearance()}, {"randomization": Randomization(range_noise=0.1)}])
def test_what_reads_each_scan_gets_it(settings: dict[str, object]) -> None:
    for td, steps in decisions(4, 3, backend="warp", task=CONTACTS, **settings):
        expected = sum(step["reward"] * active for step, active in zip(steps, taken(steps), strict=True))
        torch.testing.assert_close(td["reward"], expected)
        assert torch.equal(td["lidar"][2], steps[-1]["lidar"][2])


def test_terminations_count_each_step() -> None:
    settings = {"backend": "warp", "terminate": "no_progress(seconds=1.0)"}
    still = torch.zeros(3, 2)
    for env in (field(**settings), field(4, **settings)):
        td = env.reset(start=START, goal=GOAL)
        while not td["done"].any():
            td = env.step(td.set("action", still))["next"]
        assert (td["outcome", "steps"] == 21).all()


def test_specs_hold() -> None:
    check_env_specs(field(4), break_when_any_done="both")
