"""Actions, terminations and events: the built-in ones, and what holds for all."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import ActionConfig, Termination, contract_reward, make_env
from rover_rl.algos.evaluation.episodes import EpisodeSet
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.names import make_baseline
from rover_rl.envs.actions import Heading, WheelSpeeds, find_action
from rover_rl.envs.events import Event, Events, PowerDips, events
from rover_rl.envs.task import StepEvent
from rover_rl.envs.terminations import NoProgress
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.robots import get_robot
from rover_rl.robots.built_in import ROVER_ZERO
from rover_rl.worlds import Terrain, World
from rover_rl.worlds.pool import WorldPool

FLAT = World("flat", Terrain.flat((40.0, 40.0)))
START, GOAL = [0.0, 0.0, 0.0], [8.0, 0.0]


def flat_env(num_envs: int | None = 2, **settings: Any) -> Any:
    return make_env(world=FLAT, backend="warp", num_envs=num_envs, seed=0, **settings)


def begin(env: Any) -> Any:
    rows = env.num_envs
    return env.reset(start=torch.tensor([START] * rows), goal=torch.tensor([GOAL] * rows))


def drive(env: Any, action: list[list[float]], steps: int) -> list[Any]:
    """Takes steps with the same action. Returns what each leads to."""
    td, results = begin(env), []
    for _ in range(steps):
        td = env.step(td.set("action", torch.tensor(action)))["next"]
        results.append(td)
    return results


class Older(Termination):
    """Ends row ``i`` after ``steps[i]`` steps."""

    name = "too_old"

    def __init__(self, *steps: int) -> None:
        super().__init__()
        self.steps = torch.tensor(steps)[:, None]

    def ends(self, outcome: Any, observation: Any) -> Any:
        assert "velocities" in observation
        return outcome["steps"] >= self.steps


class Third(Older):
    """The same in the third step."""

    def __init__(self) -> None:
        super().__init__(3)


class Same(Heading):
    """The contract's action as a transform."""


# Actions


def test_twist_is_a_speed_and_a_yaw_rate_within_the_limits_of_the_drive() -> None:
    env = flat_env(action=ActionConfig(kind="twist", max_yaw_rate=2.0))
    asked = [[0.5, 0.8], [-0.3, -0.4]]
    result = drive(env, asked, 30)[-1]
    torch.testing.assert_close(result["velocities"], torch.tensor(asked), atol=0.03, rtol=0)
    assert env.action_spec_unbatched.space.high.tolist() == [1.0, 2.0]
    most = flat_env(action="twist").action_spec_unbatched.space.high
    torch.testing.assert_close(most, torch.tensor([1.0, ROVER_ZERO.drive.fastest_turn(ROVER_ZERO.wheels)]))


def test_wheels_drive_straight_turn_in_place_and_have_a_mirror_image() -> None:
    env = flat_env(action="wheels")
    ahead, turning = drive(env, [[0.4, 0.4], [-0.3, 0.3]], 30)[-1]["velocities"]
    track = ROVER_ZERO.drive.track(ROVER_ZERO.wheels)
    torch.testing.assert_close(ahead, torch.tensor([0.4, 0.0]), atol=0.02, rtol=0)
    torch.testing.assert_close(turning, torch.tensor([0.0, 0.6 / track]), atol=0.05, rtol=0)
    assert torch.equal(WheelSpeeds.mirror(torch.tensor([[0.1, 0.4]])), torch.tensor([[0.4, 0.1]]))
    assert torch.equal(find_action("twist").mirror(torch.tensor([[0.1, 0.4]])), torch.tensor([[0.1, -0.4]]))
    with pytest.raises(ValueError, match=r"'wheels' needs robots with wheels on two sides, got \['racer'\]"):
        make_env(world="forest:0", robot="racer", action="wheels", backend="warp")


def test_residual_of_0_drives_as_gridplanner() -> None:
    settings: dict[str, Any] = {"world": "maze:3", "num_envs": 2, "seed": 0, "backend": "warp"}
    added, planned = make_env(action="residual", **settings), make_env(sensors=["route"], **settings)
    planner = make_baseline("gridplanner", "rover_zero")
    ours, theirs = added.reset(), planned.reset()
    for _ in range(40):
        ours = added.step(ours.set("action", torch.zeros(2, 2)))["next"]
        theirs = planned.step(planner(theirs))["next"]
    torch.testing.assert_close(ours["pose"], theirs["pose"])
    assert ours["velocities"].abs().amax() > 0.1
    # What is added holds while it is repeated, and the driver decides in each step.
    added, repeated = (make_env(action="residual", **settings) for _ in range(2))
    repeated = repeated.append_transform(ActionRepeat(4))
    ours, theirs = added.reset(), repeated.reset()
    push = torch.tensor([[-0.1, 0.3], [-0.2, -0.4]])
    for number in range(8):
        ours = added.step(ours.set("action", push.clone()))["next"]
        theirs = repeated.step(theirs.set("action", push.clone()))["next"] if number % 4 == 3 else theirs
    assert torch.equal(ours["pose"], theirs["pose"])
    with pytest.raises(ValueError, match="'residual' needs one robot that turns in place, got 'racer'"):
        make_env(world="forest:0", robot="racer", action="residual", backend="warp")


def test_heading_is_the_action_of_the_contract_to_the_last_bit() -> None:
    actions = torch.rand(20, 2, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
    results = []
    for kind in ("heading", f"{__name__}:Same"):
        env = make_env(world="maze", num_envs=2, seed=0, backend="warp", action=kind)
        assert env.action_spec_unbatched.space.high.tolist() == pytest.approx([1.0, math.pi])
        td = env.reset()
        for action in actions:
            td = env.step(td.set("action", action.clone()))["next"]
        results.append(td)
    for key in ("pose", "velocities", "lidar", "reward"):
        assert torch.equal(results[0][key], results[1][key])


@pytest.mark.parametrize("action", ["twist", "wheels", "residual"])
def test_specs_hold_with_and_without_a_batch_and_an_action_that_is_not_finite_raises(action: str) -> None:
    for num_envs in (None, 2):
        env = flat_env(num_envs, action=action, terminate="no_progress", events="power_dips")
        check_env_specs(env, seed=0)
        td = env.reset()
        bad = env.action_spec.zero()
        bad[..., 1] = torch.nan
        with pytest.raises(ValueError, match="action must be finite numbers, got NaN or infinity in rows"):
            env.step(td.set("action", bad))


def test_hands_steer_each_action() -> None:
    limits = flat_env(action="twist").config.bounded_action
    assert find_action("heading").by_hand(limits, 1.0, 0.5) == pytest.approx((1.0, 0.5236), abs=1e-4)
    assert find_action("twist").by_hand(limits, 0.5, 0.0) == (0.5, 0.0)
    left, right = find_action("wheels").by_hand(limits, 0.0, 1.0)
    assert left == -right < 0


# Terminations


def test_a_termination_ends_an_episode_and_tells_so() -> None:
    env = flat_env(3, terminate=[Older(4, 100, 2), "no_progress"], length=4)
    results = drive(env, [[0.3, 0.0]] * 3, 4)
    assert [td["terminations", "too_old"].flatten().tolist() for td in results] == [
        [False, False, False],
        *[[False, False, True]] * 2,
        [True, False, True],
    ]
    last = results[-1]
    assert last["terminated"].flatten().tolist() == [True, False, True]
    # The time limit counts where nothing else ends the episode.
    assert last["truncated"].flatten().tolist() == [False, True, False]
    assert last["done"].all()
    assert not last["terminations", "no_progress"].any()
    again = env.reset(last.set("_reset", torch.tensor([[True], [False], [True]])))
    assert not again["terminations", "too_old"].any()


def test_rows_that_took_no_step_do_not_end() -> None:
    env = flat_env(terminate=Older(1, 1))
    td = begin(env).set("action", torch.zeros(2, 2)).set("_step", torch.tensor([True, False]))
    result = env.step(td)["next"]
    assert result["terminated"].flatten().tolist() == [True, False]
    assert result["terminations", "too_old"].flatten().tolist() == [True, False]


def test_repeated_actions_stop_where_an_episode_ends() -> None:
    env = flat_env(3, terminate=Older(6, 100, 9)).append_transform(ActionRepeat(4))
    first, second, third = drive(env, [[0.3, 0.0]] * 3, 3)
    assert not first["done"].any()
    assert second["outcome", "steps"].flatten().tolist() == [6, 8, 8]
    for key in ("done", "terminated", ("terminations", "too_old")):
        assert second[key].flatten().tolist() == [True, False, False]
        assert third[key].flatten()[1:].tolist() == [False, True]
    assert not third["truncated"].any()


@pytest.mark.parametrize("rate", [20.0, 10.0])
def test_no_progress_ends_a_rover_that_stands_and_not_one_that_drives(rate: float) -> None:
    env = flat_env(3, terminate="no_progress(seconds=1)", action="twist", control_rate=rate)
    td, ended = begin(env), torch.zeros(3, dtype=torch.bool)
    action = torch.tensor([[0.0, 0.0], [0.9, 0.0], [0.0, 1.0]])
    steps = round(1.5 * rate)
    for number in range(1, steps + 1):
        td = env.step(td.set("action", action.clone()))["next"]
        new = td["terminations", "no_progress"].squeeze(-1)
        if new.any() and not ended.any():
            assert number == rate + 1
        ended |= new
    # One that turns on the spot stands, too.
    assert ended.tolist() == [True, False, True]


def test_no_progress_counts_anew_in_each_episode_and_not_where_a_row_waits() -> None:
    env = flat_env(2, terminate=NoProgress(seconds=0.5), action="twist")
    td = begin(env)
    for number in range(1, 17):
        # The second row takes every other step, and the first begins anew in the middle.
        td["_step"] = torch.tensor([True, number % 2 == 0])
        td = env.step(td.set("action", torch.zeros(2, 2)))["next"]
        assert not td["done"].any(), number
        if number == 8:
            td = env.reset(td.set("_reset", torch.tensor([[True], [False]])))
    steps = [int(each) for each in td["outcome", "steps"]]
    assert steps == [8, 8]
    for number in range(9, 12):
        td.set("_step", torch.ones(2, dtype=torch.bool))
        td = env.step(td.set("action", torch.zeros(2, 2)))["next"]
        assert td["done"].all() == (number == 11)


def test_a_penalty_reads_why_an_episode_ended_and_tables_name_it() -> None:
    class Penalty(type(contract_reward()[0])):  # type: ignore[misc]
        name = "age"
        phases = (*StepEvent,)

        def value(self, outcome: Any, observation: Any) -> Any:
            return -7.0 * observation["terminations", "too_old"]

    env = flat_env(2, terminate=Older(2, 5), reward=[Penalty()])
    assert [td["reward"].flatten().tolist() for td in drive(env, [[0.0, 0.0]] * 2, 2)] == [[0.0, 0.0], [-7.0, 0.0]]
    start, goal = torch.tensor([START] * 2), torch.tensor([GOAL] * 2)
    episodes = EpisodeSet("flat", WorldPool(FLAT), 0, start, goal, shortest=torch.full((2,), 7.5))
    config = flat_env(terminate=Third).config
    result = evaluate(None, episodes, name="random", seconds=1.0, env=config)
    assert {drive.ending for drive in result.trajectories} == {"too old"}
    assert result.metrics["ending_own"].value == pytest.approx(1.0)


# Events


def dips(num_envs: int, seed: int, steps: int, **settings: float) -> torch.Tensor:
    """Whether the power is away in each step, ``[N, T]``, of rows with other seeds."""
    env = make_env(world=FLAT, backend="warp", num_envs=num_envs, seed=seed, events=PowerDips(**settings))
    (event,) = [stage for stage in env.base_env._simulation.stages if isinstance(stage, Events)]
    env.reset()
    commands = []
    for number in range(steps):
        state = env.base_env.state
        state.steps, state.active = torch.full((num_envs, 1), number), None
        commands.append(event.command(torch.ones(num_envs, 2), state)[:, :1] == 0)
    return torch.cat(commands, -1)


def test_power_dips_are_those_of_the_row_in_any_batch_and_as_many_as_asked_for() -> None:
    many = dips(64, 0, 400, rate=0.5, seconds=0.3)
    assert torch.equal(dips(2, 5, 400, rate=0.5, seconds=0.3), many[5:7])
    # Dips of 0.3 s that may overlap: no power in 1 - exp(-0.5 * 0.3) of the time.
    assert many.float().mean().item() == pytest.approx(0.139, abs=0.02)
    begins = many[:, 1:] & ~many[:, :-1]
    # They last for six steps, or longer.
    first = begins.float().argmax(-1)
    assert all(many[row, step + 1 : step + 7].all() for row, step in enumerate(first.tolist()) if step)
    assert not dips(2, 0, 50, rate=0).any()


def test_a_rover_without_power_slows_down() -> None:
    env = flat_env(1, action="twist", events="power_dips(rate=20, seconds=1)")
    assert drive(env, [[1.0, 0.0]], 20)[-1]["velocities"].abs().max() < 0.02


def test_events_of_one_class_draw_other_numbers_and_commands_are_those_that_the_drive_can_follow() -> None:
    class Fast(Event):
        def begin(self, mask: Any, keys: Any) -> None:
            self.drawn = self.uniform(keys)

        def command(self, command: Any, state: Any) -> Any:
            return command * 1e6

    one, other = made = events([Fast, Fast])
    for event in made:
        event.begin(torch.ones(2, 1, dtype=torch.bool), torch.tensor([[5], [6]]))
    assert not one.drawn.equal(other.drawn)
    env = flat_env(1, action="twist", events=[Fast])
    assert drive(env, [[0.5, 0.0]], 60)[-1]["velocities"][0, 0].item() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda command: command * math.nan, r"Bad.command must return finite numbers of shape \(1, 2\)"),
        (lambda command: command[:, :1], r"got shape \(1, 1\)"),
        (lambda command: None, "got NoneType"),
    ],
)
def test_what_an_event_makes_of_commands_is_checked(made: Any, message: str) -> None:
    class Bad(Event):
        def command(self, command: Any, state: Any) -> Any:
            return made(command)

    with pytest.raises(ValueError, match=message):
        drive(flat_env(1, action="twist", events=[Bad]), [[0.5, 0.0]], 1)


@pytest.mark.parametrize("ended", [torch.zeros(1, 1), torch.zeros(1, dtype=torch.bool), None])
def test_what_a_termination_returns_is_checked(ended: Any) -> None:
    class Bad(Termination):
        name = "bad"

        def ends(self, outcome: Any, observation: Any) -> Any:
            return ended

    with pytest.raises(ValueError, match=r"Bad.ends must return bool \(1, 1\), got"):
        drive(flat_env(1, action="twist", terminate=[Bad]), [[0.5, 0.0]], 1)


def test_events_of_ones_own_may_serve_several_environments() -> None:
    class Pull(Event):
        def begin(self, mask: Any, keys: Any) -> None:
            self.pull = self.uniform(keys)

        def command(self, command: Any, state: Any) -> Any:
            return command + torch.cat((torch.zeros_like(self.pull), self.pull), -1)

    pull = Pull()
    large, small = (flat_env(rows, action="twist", events=pull) for rows in (3, 1))
    rates = [drive(env, [[0.2, 0.0]] * env.num_envs, 20)[-1]["velocities"][:, 1] for env in (large, small)]
    torch.testing.assert_close(rates[0][:1], rates[1])
    assert rates[0].min() > 0.0
    assert len({round(rate, 2) for rate in rates[0].tolist()}) == 3


# Mistakes


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"action": "twsit"}, "unknown action 'twsit', perhaps 'twist'; use one of ['heading', 'residual', 'twist'"),
        ({"action": "rover_rl.envs.actions:ACTION"}, "or an Action class, got 'rover_rl.envs.actions:ACTION'"),
        ({"terminate": "no_progres"}, "unknown termination 'no_progres', perhaps 'no_progress'; use one of"),
        ({"terminate": "no_progress(hours=1)"}, "termination 'no_progress' is called with the settings ['hours']"),
        ({"terminate": "no_progress(seconds=-1)"}, "seconds must be positive"),
        ({"terminate": [Older(1), Older(2)]}, "terminations must have names of their own, got ['too_old', 'too_old']"),
        ({"terminate": PowerDips}, "a termination must be a Termination, or a function or class that makes one"),
        ({"events": "power_dip"}, "unknown event 'power_dip', perhaps 'power_dips'"),
        ({"events": NoProgress}, "an event must be a Event, or a function or class that makes one"),
        ({"task": "maizes"}, "unknown task 'maizes', perhaps 'mazes'"),
    ],
)
def test_a_mistake_is_told_before_anything_is_simulated(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        make_env(**{"world": "maze"} | settings)


def test_the_robot_of_another_drive_bounds_the_action() -> None:
    racer = get_robot("racer")
    env = make_env(world="forest:0", robot="racer", action="twist", backend="warp")
    most = [racer.drive.max_speed, racer.drive.fastest_turn(racer.wheels)]
    assert env.action_spec_unbatched.space.high.tolist() == pytest.approx(most)
