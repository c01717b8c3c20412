"""The contract, rule by rule: its numbers, its reward on recorded rollouts, and each of its endings."""

from __future__ import annotations

import inspect
import math
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from itertools import product

import hypothesis
import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from scipy.stats import chisquare
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl import RewardConfig, RoverEnv, TaskConfig, World, box, make_env
from rover_rl.envs.control import HeadingController, HeadingGains
from rover_rl.envs.placement import Placement
from rover_rl.envs.rng import episode_keys, random_bits, row_keys, to_index, to_unit
from rover_rl.envs.sensing import LidarPooling
from rover_rl.envs.task import EVENTS, PositionHistory, StepEvent, compute_terminations, heading_alignment, target_info
from rover_rl.sims.robots import get_robot
from rover_rl.sims.rotations import wrap_angle
from rover_rl.sims.worlds import Terrain, get_world
from tests.envs import transcription as contract
from tests.envs.scripted import Moment, ScriptedBackend

WORLD_NAMES = ("inspect", "moon", "maze")
NAME_OF_PHASE = {
    StepEvent.FLIP: "flip",
    StepEvent.JAM: "jam",
    StepEvent.OUT_OF_BOUNDS: "out_of_bounds",
    StepEvent.STUCK: "stuck",
    StepEvent.GOAL: "goal",
    StepEvent.COLLISION: "collision",
    StepEvent.DENSE: "dense",
}
OBSERVATION = ("lidar", "pose", "imu", "target", "velocities")
CPU = torch.device("cpu")
BOUNDS = ((-30.0, 30.0), (-30.0, 30.0))
AREA, GOAL_AREA = ((-1.0, 1.0), (-1.0, 1.0)), ((-2.0, 2.0), (-2.0, 2.0))
FAR = (20.0, 0.0)
"""A goal that a scripted rover near the origin does not reach."""


# -----------------------------------------------------------------------------------------------------------
# Environments that play a script, and their witness


@lru_cache
def meadow() -> World:
    """Level ground with nothing on it, the bounds of the maze."""
    return World("meadow", Terrain.flat((8, 8)), spawn_range=AREA, goal_range=GOAL_AREA, bounds=BOUNDS)


def scripted(*scripts: list[Moment], reward: str = "contract", **settings) -> EnvBase:
    """An environment whose rovers follow ``scripts``, one a row."""
    settings = {"world_n": meadow(), "lidar_beams": 32, "seed": 0, **settings}
    env = make_env(num_envs=len(scripts), backend=ScriptedBackend(), reward=reward, **settings)
    bare(env).simulator.scripts = scripts
    return env


def bare(env: EnvBase) -> RoverEnv:
    return getattr(env, "base_env", env)


def pairs(value: tuple[float, float], count: int = 1) -> Tensor:
    return torch.tensor([value] * count)


def play(env: EnvBase, steps: int, goal: tuple[float, float] = FAR, action=(0.0, 0.0)) -> list[TensorDict]:
    """What ``steps`` steps of one action give, after a reset; no row is reset again."""
    rows = bare(env).num_envs
    td = env.reset(goal=pairs(goal, rows))
    given = []
    for _ in range(steps):
        td["action"] = pairs(action, rows)
        td = env.step(td)["next"]
        given.append(td)
    return given


def rewards(given: list[TensorDict]) -> list[float]:
    """The rewards of row 0."""
    return [round(td["reward"][0].item(), 5) for td in given]


def phases(given: list[TensorDict], row: int = 0) -> list[StepEvent]:
    return [StepEvent(td["outcome", "phase"][row].item()) for td in given]


def moving(steps: int, speed: float = 0.01, **values: float) -> list[Moment]:
    """A script of a rover that moves along x by ``speed`` metres a step, so that it is not stuck."""
    return [Moment(x=speed * k, **values) for k in range(steps + 1)]


@dataclass
class Verdict:
    """One step of one row: what the environment gave and what the contract asks for."""

    row: int
    observation: dict[str, list[float]]
    expected_observation: dict[str, list[float]]
    command: list[float]
    expected_command: tuple[float, float]
    outcome: dict[str, float | bool | int]
    components: dict[str, float]
    reward: float
    terminated: bool
    truncated: bool
    done: bool
    goal_before: tuple[float, float]
    goal: tuple[float, float]
    position: tuple[float, float]
    expected: contract.Step
    expected_total_steps: int


class Witness:
    """Follows an environment row by row with the transcription, fed only with raw values and given goals."""

    def __init__(self, env: EnvBase, bounds: tuple, **settings: int) -> None:
        self.env = env
        self.rows = range(bare(env).num_envs)
        self.rovers = [contract.ContractRover(bounds, **settings) for _ in self.rows]
        self.first_observations: list[tuple[dict, dict]] = []
        self.verdicts: list[Verdict] = []
        simulator = bare(env).simulator
        self.step_simulator, simulator.step = simulator.step, self._note_commands

    def _note_commands(self, commands: Tensor, active: Tensor | None = None):
        self.commands = commands.tolist()
        return self.step_simulator(commands, active)

    def readings(self) -> list[contract.Reading]:
        raw = bare(self.env).rover_state
        columns = zip(
            raw.position.tolist(),
            raw.orientation.tolist(),
            raw.ranges.tolist(),
            raw.linear_velocity.flatten().tolist(),
            raw.angular_velocity.flatten().tolist(),
            strict=True,
        )
        return [contract.Reading(*p, *contract.euler(q), ranges, v, w) for p, q, ranges, v, w in columns]

    def reset(self, td: TensorDict, rows: list[int]) -> None:
        readings, goals = self.readings(), bare(self.env).goal.tolist()
        for row in rows:
            self.rovers[row].reset(readings[row], tuple(goals[row]))
            self.first_observations.append((observed(td, row), self.rovers[row].observation()))

    def step(self, td: TensorDict) -> TensorDict:
        """Steps the environment with the action in ``td`` and notes what came of it."""
        actions, goals_before = td["action"].tolist(), bare(self.env).goal.tolist()
        expected_commands = [rover.command(actions[row]) for row, rover in enumerate(self.rovers)]
        td = self.env.step(td)
        given, readings, goals = td["next"], self.readings(), bare(self.env).goal.tolist()
        for row, rover in enumerate(self.rovers):
            expected = rover.step(readings[row], tuple(goals[row]))
            self.verdicts.append(
                Verdict(
                    row=row,
                    observation=observed(given, row),
                    expected_observation=rover.observation(),
                    command=self.commands[row],
                    expected_command=expected_commands[row],
                    outcome={name: value[row].item() for name, value in given["outcome"].items()},
                    components={n: v[row].item() for n, v in given["reward_components"].items()},
                    reward=given["reward"][row].item(),
                    terminated=given["terminated"][row].item(),
                    truncated=given["truncated"][row].item(),
                    done=given["done"][row].item(),
                    goal_before=tuple(goals_before[row]),
                    goal=tuple(goals[row]),
                    position=(readings[row].x, readings[row].y),
                    expected=expected,
                    expected_total_steps=rover.total_steps,
                )
            )
        return td


def observed(td: TensorDict, row: int) -> dict[str, list[float]]:
    return {key: td[key][row].tolist() for key in OBSERVATION}


def witness(env: EnvBase, bounds: tuple, steps: int, policy, start=None, goal=None, **settings: int) -> Witness:
    """``steps`` steps of ``policy`` with automatic resets, witnessed."""
    seen = Witness(env, bounds, **settings)
    td = env.reset(start=start, goal=goal)
    seen.reset(td, list(seen.rows))
    for k in range(steps):
        td["action"] = policy(td, bare(env), k)
        td = env.step_mdp(seen.step(td))
        done = td["done"].flatten().nonzero().flatten().tolist()
        td = env.maybe_reset(td)
        if done:
            seen.reset(td, done)
    return seen


def assert_same_angle(given: float, expected: float, tolerance: float = 1e-5) -> None:
    assert abs(contract.normalize(given - expected)) < tolerance


def assert_same_observation(given: dict[str, list[float]], expected: dict[str, list[float]]) -> None:
    assert given["lidar"] == pytest.approx(expected["lidar"], abs=1e-6)
    assert given["pose"] == pytest.approx(expected["pose"], abs=1e-5)
    assert given["velocities"] == pytest.approx(expected["velocities"], abs=1e-5)
    for angle, right in zip(given["imu"], expected["imu"], strict=True):
        assert_same_angle(angle, right)
    assert given["target"][0] == pytest.approx(expected["target"][0], abs=1e-5)
    assert_same_angle(given["target"][1], expected["target"][1], 1e-5 + 1e-5 / max(expected["target"][0], 1e-3))


def check_witnessed(seen: Witness) -> None:
    """Everything that the environment gave is what the transcription says."""
    close_calls = 0
    for given, expected in seen.first_observations:
        assert_same_observation(given, expected)
    for v in seen.verdicts:
        assert_same_observation(v.observation, v.expected_observation)
        assert v.command == pytest.approx(v.expected_command, abs=1e-4)
        assert {name: v.outcome[name] for name in contract.EVENTS} == v.expected.events
        assert not v.outcome["invalid_action"]
        assert NAME_OF_PHASE[v.outcome["phase"]] == v.expected.decided_by
        assert (v.terminated, v.truncated) == (v.expected.terminated, v.expected.truncated)
        assert v.done == (v.terminated or v.truncated)
        assert (v.outcome["steps"], v.outcome["total_steps"]) == (v.expected.steps, v.expected_total_steps)
        assert v.outcome["progress"] == pytest.approx(v.expected.progress, abs=1e-5)
        if v.expected.margin < 3e-6:
            # Float32 may take the distance reward where exact numbers take the idle penalty.
            close_calls += 1
            continue
        assert v.components == pytest.approx(v.expected.components, abs=1e-5)
        assert v.reward == pytest.approx(v.expected.reward, abs=1e-5)
    assert close_calls <= len(seen.verdicts) // 200


# -----------------------------------------------------------------------------------------------------------
# Constructor


def test_the_constructor_takes_the_contracts_ten_arguments_in_order_with_their_defaults():
    parameters = inspect.signature(RoverEnv.__init__).parameters.values()
    positional = [(p.name, p.default) for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
    assert positional[1:] == [
        ("size", (64, 64)),
        ("length", 2000),
        ("scan_topic", "/scan"),
        ("imu_topic", "/imu/data"),
        ("cmd_vel_topic", "/cmd_vel"),
        ("camera_topic", "/camera/image_raw"),
        ("world_n", "inspect"),
        ("connection_check_timeout", 30),
        ("lidar_points", 32),
        ("max_lidar_range", 12.0),
    ]


def test_further_settings_are_keyword_only_with_the_defaults_of_the_design():
    parameters = inspect.signature(RoverEnv.__init__).parameters.values()
    keywords = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    settled = {
        "num_envs": 1,
        "backend": "bullet",
        "robot": "rover_zero",
        "lidar_beams": 128,
        "seed": None,
        "device": None,
        "end_on_goal": False,
    }
    assert settled.items() <= keywords.items()


def test_the_task_has_the_contracts_thresholds():
    assert asdict(TaskConfig()) == {
        "success_distance": 0.5,
        "min_goal_distance": 1.0,
        "collision_threshold": 0.3,
        "collision_window": 15,
        "flip_threshold": 1.48,
        "stuck_window": 600,
        "stuck_threshold": 0.001,
    }


def test_the_reward_has_the_contracts_numbers():
    assert asdict(RewardConfig()) == {
        "goal_reward": 100.0,
        "distance_delta_scale": 0.3,
        "final_reward_multiplier": 1.5,
        "idle_penalty": -0.03,
        "min_progress": 0.001,
        "min_alignment": 0.0,
        "velocity_scale": 0.0025,
        "turn_scale": -0.0015,
        "collision_penalty": -0.5,
        "stuck_penalty": -25.0,
        "general_penalty": -20.0,
        "flip_grace_steps": 500,
        "out_of_bounds_penalty": -10.0,
    }


def test_the_heading_pid_has_the_contracts_gains():
    assert asdict(HeadingGains()) == {"kp": 2.0, "ki": 0.0, "kd": 0.1, "max_output": 7.0}


def test_configurations_are_frozen():
    for config in (TaskConfig(), RewardConfig(), HeadingGains()):
        for field in fields(config):
            with pytest.raises(AttributeError):
                setattr(config, field.name, 1)


# -----------------------------------------------------------------------------------------------------------
# Observation and action space


SPACE = {
    "lidar": ([0.0] * 32, [12.0] * 32),
    "pose": ([-30.0, -30.0, -10.0], [30.0, 30.0, 10.0]),
    "imu": ([-math.pi] * 3, [math.pi] * 3),
    "target": ([0.0, -math.pi], [100.0, math.pi]),
    "velocities": ([-10.0, -10.0], [10.0, 10.0]),
}


@pytest.mark.parametrize("key", SPACE)
def test_observation_bounds_shape_and_dtype_are_the_contracts(key):
    low, high = SPACE[key]
    spec = scripted([Moment()], [Moment()]).observation_spec[key]
    assert spec.shape == (2, len(low))
    assert spec.dtype == torch.float32
    for row in range(2):
        assert spec.space.low[row].tolist() == torch.tensor(low).tolist()
        assert spec.space.high[row].tolist() == torch.tensor(high).tolist()


def test_the_action_space_is_speed_within_1_and_heading_offset_within_pi():
    spec = scripted([Moment()], [Moment()]).full_action_spec["action"]
    assert spec.shape == (2, 2)
    assert spec.dtype == torch.float32
    assert spec.space.low.tolist() == torch.tensor([[-1.0, -math.pi]] * 2).tolist()
    assert spec.space.high.tolist() == torch.tensor([[1.0, math.pi]] * 2).tolist()


def test_lidar_points_and_max_lidar_range_shape_the_lidar_space():
    env = scripted([Moment(ranges=7.0)], lidar_points=8, max_lidar_range=6.0)
    assert env.observation_spec["lidar"].shape == (1, 8)
    assert env.observation_spec["lidar"].space.high.unique().tolist() == [6.0]
    assert env.reset()["lidar"].tolist() == [[6.0] * 8]


def test_reward_and_done_entries_are_one_column_a_row():
    env = scripted([Moment()], [Moment()])
    given = play(env, 1)[0]
    for key in ("reward", "done", "terminated", "truncated"):
        assert given[key].shape == (2, 1)
    assert given["reward"].dtype == torch.float32
    assert given["done"].dtype == torch.bool


def test_imu_is_pitch_then_roll_then_yaw():
    td = scripted([Moment(roll=0.1, pitch=0.2, yaw=0.3)]).reset()
    assert td["imu"][0].tolist() == pytest.approx([0.2, 0.1, 0.3], abs=1e-6)


def test_pose_is_x_y_z_and_velocities_are_linear_then_angular():
    td = scripted([Moment(x=1.0, y=2.0, z=3.0, v=0.5, w=-0.7)]).reset()
    assert td["pose"][0].tolist() == [1.0, 2.0, 3.0]
    assert td["velocities"][0].tolist() == pytest.approx([0.5, -0.7])


def test_the_observation_is_clipped_to_its_bounds_and_the_outcome_is_not():
    env = scripted([Moment(x=-31.0, y=150.0, z=11.0, v=12.0, w=-13.0, ranges=30.0)] * 2)
    given = play(env, 1, goal=(0.0, 0.0))[0]
    assert given["pose"][0].tolist() == [-30.0, 30.0, 10.0]
    assert given["velocities"][0].tolist() == [10.0, -10.0]
    assert given["target"][0, 0] == 100.0
    assert given["lidar"].unique().tolist() == [12.0]
    assert given["outcome", "linear_velocity"].item() == 12.0
    assert given["outcome", "angular_velocity"].item() == -13.0


@pytest.mark.parametrize(
    ("yaw", "goal", "angle"),
    [
        (0.0, (3.0, 4.0), math.atan2(4, 3)),
        (math.pi / 2, (3.0, 4.0), math.atan2(4, 3) - math.pi / 2),
        (3.0, (3.0, -4.0), math.atan2(-4, 3) - 3.0 + 2 * math.pi),
        (0.0, (-5.0, 0.0), math.pi),
    ],
)
def test_target_is_the_distance_and_the_bearing_relative_to_yaw(yaw, goal, angle):
    distance, relative = scripted([Moment(yaw=yaw)]).reset(goal=pairs(goal))["target"][0].tolist()
    assert distance == pytest.approx(5.0)
    assert_same_angle(relative, angle)


# -----------------------------------------------------------------------------------------------------------
# Worlds


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_each_world_has_the_contracts_ranges_and_bounds(name):
    world, table = get_world(name), contract.WORLDS[name]
    assert world.name == name
    assert world.goal_range == (table.rand_goal_x_range, table.rand_goal_y_range)
    assert world.spawn_range == (table.rand_x_range, table.rand_y_range)
    assert world.bounds == (table.too_far_away_x, table.too_far_away_y)


def test_inspect_drops_the_rover_from_5_5_m_and_from_6_5_m_in_its_south_west_corner():
    points = torch.tensor([[-20.0, -20.0], [-25.0, -25.0], [-24.5, -25.0], [-25.0, -24.5], [-25.0, -20.0]])
    assert get_world("inspect").drop_height(points).tolist() == [5.5, 6.5, 5.5, 5.5, 5.5]


@pytest.mark.parametrize("name", ["moon", "maze"])
def test_the_other_worlds_drop_the_rover_from_0_75_m(name):
    assert get_world(name).drop_height(torch.tensor([[0.0, 0.0], [-3.9, -3.9]])).tolist() == [0.75, 0.75]


@pytest.mark.parametrize("name", WORLD_NAMES)
def test_starts_and_goals_are_drawn_in_the_worlds_ranges_with_goals_1_m_away(name):
    rows, table = 2000, contract.WORLDS[name]
    placement = Placement([get_world(name)] * rows, get_robot("rover_zero"), 1.0, CPU)
    keys = row_keys(0, rows, CPU)
    start = placement.draw_start(keys)
    goal = placement.draw_goal(keys, torch.zeros_like(keys), start[:, :2])
    for points, x_range, y_range in (
        (start, table.rand_x_range, table.rand_y_range),
        (goal, table.rand_goal_x_range, table.rand_goal_y_range),
    ):
        for axis, (low, high) in enumerate((x_range, y_range)):
            assert points[:, axis].min() >= low
            assert points[:, axis].max() <= high
            # The free cells reach nearly everywhere.
            assert points[:, axis].min() < low + 1
            assert points[:, axis].max() > high - 1
    assert (goal - start[:, :2]).norm(dim=-1).min() >= 1.0


@pytest.mark.parametrize("name", ["moon", "maze"])
def test_the_starting_yaw_is_anything_from_minus_pi_to_pi(name):
    keys = row_keys(0, 4000, CPU)
    yaw = Placement([get_world(name)] * 4000, get_robot("rover_zero"), 1.0, CPU).draw_start(keys)[:, 2]
    assert yaw.abs().max() <= math.pi
    assert min(torch.histc(yaw, 8, -math.pi, math.pi).tolist()) > 250


@pytest.mark.parametrize("side", ["x_low", "x_high", "y_low", "y_high"])
@pytest.mark.parametrize("name", WORLD_NAMES)
def test_too_far_away_is_outside_of_the_worlds_bounds_on_every_side(name, side):
    table = contract.WORLDS[name]
    limits = table.too_far_away_x if side[0] == "x" else table.too_far_away_y
    limit, outward = (limits[0], -1) if side.endswith("low") else (limits[1], 1)
    middle = [sum(table.too_far_away_x) / 2, sum(table.too_far_away_y) / 2]

    def script(beyond: float) -> list[Moment]:
        place = list(middle)
        place[side[0] == "y"] = limit + outward * beyond
        return [Moment(*middle), Moment(*place)]

    env = scripted(script(-0.01), script(0.01), world_n=name)
    given = play(env, 1, goal=(100.0, 100.0))[0]
    assert given["outcome", "out_of_bounds"].flatten().tolist() == [False, True]
    assert given["reward"][1].item() == -10.0


def test_rows_in_different_worlds_have_their_own_bounds():
    outside_of_inspect = [Moment(x=-20.0, y=-20.0), Moment(x=-12.0, y=-20.0)]
    env = scripted(outside_of_inspect, outside_of_inspect, world_n=["inspect", "maze"])
    given = play(env, 1)[0]
    assert given["terminated"].flatten().tolist() == [True, False]


# -----------------------------------------------------------------------------------------------------------
# Heading controller


def commands(env: EnvBase, actions: list[tuple[float, float]]) -> list[list[float]]:
    """The twists that row 0 is sent for ``actions``, after a reset."""
    td = env.reset(goal=pairs(FAR))
    sent = []
    for action in actions:
        td["action"] = pairs(action)
        td = env.step(td)["next"]
        sent.append(bare(env).simulator.commands[-1][0].tolist())
    return sent


def test_the_linear_speed_is_commanded_as_it_is():
    assert [v for v, _ in commands(scripted([Moment()]), [(0.7, 0.0), (-1.0, 0.0)])] == pytest.approx([0.7, -1.0])


def test_the_error_is_the_heading_offset_whatever_the_yaw():
    for yaw in (0.0, 1.5, -3.1, 3.1):
        (_, first), (_, second) = commands(scripted([Moment(yaw=yaw)]), [(0.0, 0.2), (0.0, 0.2)])
        assert first == pytest.approx(2.0 * 0.2 + 0.1 * 0.2 / 0.05, abs=1e-4)
        assert second == pytest.approx(2.0 * 0.2, abs=1e-4)


def test_the_derivative_is_the_change_of_the_error_over_0_05_s():
    sent = commands(scripted([Moment()]), [(0.0, 0.1), (0.0, 0.3), (0.0, -0.2)])
    assert [w for _, w in sent] == pytest.approx([0.4, 0.6 + 0.1 * 0.2 / 0.05, -0.4 - 0.1 * 0.5 / 0.05], abs=1e-4)


def test_the_yaw_rate_is_clipped_to_7_rad_s():
    assert [w for _, w in commands(scripted([Moment()]), [(0.0, 3.0), (0.0, -3.0)])] == [7.0, -7.0]


def test_finite_actions_outside_of_their_bounds_are_clipped():
    inside, outside = ([(1.0, math.pi), (-1.0, 0.1)], [(5.0, 9.0), (-3.0, 0.1)])
    assert commands(scripted([Moment()]), outside) == commands(scripted([Moment()]), inside)


def test_a_reset_clears_the_controller():
    env = scripted([Moment()])
    assert commands(env, [(0.0, 0.3)]) == commands(env, [(0.0, 0.3)])


# Just inside of the wrap, where one rounding would turn the sign of the whole error.
offsets = st.floats(-3.125, 3.125, width=32)
yaws = st.floats(-3.140625, 3.140625, width=32)


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(
    headings=st.lists(st.tuples(offsets, yaws), min_size=1, max_size=8),
    ki=st.sampled_from([0.0, 0.5]),
    dt=st.sampled_from([0.05, 0.1]),
)
def test_the_heading_controller_is_the_contracts_pid(headings, ki, dt):
    controller = HeadingController(1, HeadingGains(ki=ki))
    pid = contract.HeadingPid(ki=ki)
    for offset, yaw in headings:
        desired, current = torch.tensor([[yaw + offset]]), torch.tensor([[yaw]])
        rate = controller(desired, current, torch.tensor([[dt]])).item()
        assert rate == pytest.approx(pid(yaw + offset, yaw, dt), abs=1e-4)


def test_rows_that_are_not_active_keep_their_controller():
    controller, column = HeadingController(2), torch.ones(2, 1)
    controller(0.2 * column, 0 * column, 0.05 * column)
    controller(0.5 * column, 0 * column, 0.05 * column, torch.tensor([[True], [False]]))
    rates = controller(0.5 * column, 0 * column, 0.05 * column).flatten().tolist()
    assert rates == pytest.approx([1.0, 1.0 + 0.1 * 0.3 / 0.05], abs=1e-5)


# -----------------------------------------------------------------------------------------------------------
# Lidar


def test_infinite_and_nan_readings_become_max_lidar_range_and_minus_infinity_0():
    td = scripted([Moment(ranges=[math.inf, math.nan, -math.inf, -1.0, 13.0, 3.0] + [5.0] * 26)]).reset()
    assert td["lidar"][0, :7].tolist() == [12.0, 12.0, 0.0, 0.0, 12.0, 3.0, 5.0]


def test_nan_never_hides_a_nearer_reading_of_its_segment():
    td = scripted([Moment(ranges=[math.nan, 2.0] + [5.0] * 62)], lidar_beams=64).reset()
    assert td["lidar"][0, 0] == 2.0


def test_each_reading_is_the_minimum_of_a_segment_of_neighbouring_beams_from_straight_ahead():
    td = scripted([Moment(ranges=[1.0 + k for k in range(8)])], lidar_beams=8, lidar_points=4).reset()
    assert td["lidar"][0].tolist() == [1.0, 3.0, 5.0, 7.0]


@hypothesis.settings(max_examples=150, deadline=None)
@hypothesis.given(data=st.data(), points=st.integers(1, 40), extra=st.integers(0, 60))
def test_pooling_is_the_contracts_for_any_beams_and_any_readings(data, points, extra):
    reading = st.one_of(st.floats(-1, 15, width=32), st.sampled_from([math.inf, -math.inf, math.nan, 0.0, 12.0, -0.0]))
    scan = data.draw(st.lists(reading, min_size=points + extra, max_size=points + extra))
    pooled = LidarPooling(points + extra, points, 12.0)(torch.tensor([scan]))[0].tolist()
    assert pooled == pytest.approx(contract.pool(scan, points), abs=0)


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(points=st.integers(1, 40), extra=st.integers(0, 100))
def test_every_beam_counts_in_exactly_one_segment_and_segments_differ_by_one_beam_at_most(points, extra):
    beams = points + extra
    near_one_by_one = torch.full((beams, beams), 9.0).fill_diagonal_(1.0)
    seen = LidarPooling(beams, points, 12.0)(near_one_by_one) == 1.0
    assert seen.sum(1).tolist() == [1] * beams
    sizes = seen.sum(0)
    assert sizes.max() - sizes.min() <= 1
    assert seen.int().argmax(1).diff().ge(0).all()


# -----------------------------------------------------------------------------------------------------------
# Target, alignment and the order of the rules


@hypothesis.settings(max_examples=200, deadline=None)
@hypothesis.given(st.floats(-50, 50, width=32))
def test_wrap_angle_is_atan2_of_sine_and_cosine(angle):
    wrapped = wrap_angle(torch.tensor([angle])).item()
    assert abs(wrapped) <= torch.tensor(math.pi).item()
    assert_same_angle(wrapped, math.atan2(math.sin(angle), math.cos(angle)))


coordinates = st.floats(-40, 40, width=32)


@hypothesis.settings(max_examples=200, deadline=None)
@hypothesis.given(coordinates, coordinates, yaws, coordinates, coordinates)
def test_target_info_is_the_contracts(x, y, yaw, goal_x, goal_y):
    distance, angle = contract.target_info(x, y, yaw, (goal_x, goal_y))
    hypothesis.assume(distance > 0.1)
    given = target_info(torch.tensor([[x, y]]), torch.tensor([[yaw]]), torch.tensor([[goal_x, goal_y]]))[0].tolist()
    assert given[0] == pytest.approx(distance, abs=1e-4)
    assert_same_angle(given[1], angle, 1e-4)


@pytest.mark.parametrize(
    ("angle", "alignment"),
    [
        (0.0, 1.0),
        (math.pi / 4, 0.5),
        (-math.pi / 4, 0.5),
        (math.pi / 2, 0.0),
        (math.pi, -1.0),
        (-math.pi, -1.0),
    ],
)
def test_alignment_falls_from_1_straight_ahead_over_0_at_a_right_angle_to_minus_1(angle, alignment):
    assert heading_alignment(torch.tensor([angle])).item() == pytest.approx(alignment, abs=1e-6)


def judged(*, invalid=False, flip=False, jam=False, out=False, stuck=False, goal=False, collision=False):
    """The events and the phase of one row to which all this happens."""
    return compute_terminations(
        position=torch.tensor([[5.0 if out else 0.0, 0.0]]),
        tilt=torch.tensor([[0.0, -1.6 if flip else 0.0]]),
        distance=torch.tensor([[0.4 if goal else 3.0]]),
        displacement=torch.tensor([[0.0 if stuck else math.inf]]),
        collision_steps=torch.tensor([[16 if jam else int(collision)]]),
        invalid=torch.tensor([[invalid]]),
        bounds=(torch.tensor([[-4.0, -4.0]]), torch.tensor([[4.0, 4.0]])),
        config=TaskConfig(),
    )


def test_rules_decide_in_the_contracts_order():
    names = ("invalid", "flip", "jam", "out", "stuck", "goal", "collision")
    for chosen in product([False, True], repeat=len(names)):
        events, phase = judged(**dict(zip(names, chosen, strict=True)))
        assert phase.item() == (chosen.index(True) if True in chosen else StepEvent.DENSE)
        invalid, flip, jam, out, stuck, goal, collision = chosen
        ended = invalid or flip or jam or out or stuck
        # Every event is told, whichever decides; a jam is a collision, and an ending leaves no goal.
        expected = [invalid, flip, jam, out, stuck, goal and not ended, collision or jam]
        assert dict(zip(EVENTS, events[0].tolist(), strict=True)) == dict(zip(EVENTS, expected, strict=True))


def test_phases_are_numbered_in_the_contracts_order():
    order = ["FLIP", "JAM", "OUT_OF_BOUNDS", "STUCK", "GOAL", "COLLISION", "DENSE", "NONE"]
    assert [phase.name for phase in StepEvent] == ["INVALID_ACTION", *order]


# -----------------------------------------------------------------------------------------------------------
# Goal, dense reward and collision, on scripts


def test_below_0_5_m_the_reward_is_100_and_the_episode_goes_on_with_a_new_goal():
    env = scripted([Moment(x=1.0), Moment(x=0.499)], [Moment(x=1.0), Moment(x=0.5)])
    given = play(env, 1, goal=(0.0, 0.0))[0]
    assert given["outcome", "goal_reached"].flatten().tolist() == [True, False]
    assert given["reward"][0].item() == 100.0
    assert given["reward"][1].item() < 1.0
    assert not given["done"].any()
    goals = bare(env).goal
    assert goals[0].tolist() != [0.0, 0.0]
    assert goals[1].tolist() == [0.0, 0.0]


def test_a_new_goal_lies_1_m_away_or_more_in_the_worlds_goal_range():
    rows = 64
    env = scripted(*[[Moment(x=1.0), Moment()]] * rows)
    play(env, 1, goal=(0.0, 0.0))
    goals = bare(env).goal
    assert goals.norm(dim=-1).min() >= 1.0
    assert goals.abs().max() <= 2.0
    assert len(goals.unique(dim=0)) == rows


def test_the_target_observed_after_a_goal_is_the_new_one_and_progress_restarts_on_it():
    env = scripted([Moment(x=1.0), Moment(), Moment(y=0.03, ranges=5.0)])
    first, second = play(env, 2, goal=(0.0, 0.0))
    goal = bare(env).goal[0].tolist()
    before, after = math.dist((0, 0), goal), math.dist((0, 0.03), goal)
    assert first["outcome", "progress"].item() == pytest.approx(1.0)
    assert first["target"][0, 0].item() == pytest.approx(before, abs=1e-6)
    assert second["outcome", "progress"].item() == pytest.approx(before - after, abs=1e-6)


def test_each_goal_of_an_episode_is_another_one():
    env = scripted([Moment(x=1.0), Moment()])
    td, goals = env.reset(goal=pairs((0.0, 0.0))), []
    for _ in range(5):
        td["action"] = pairs((0.0, 0.0))
        td = env.step(td)["next"]
        goals.append(tuple(bare(env).goal[0].tolist()))
        bare(env).simulator.scripts = [[Moment(*goals[-1])]]
    assert len(set(goals)) == 5


def test_the_bare_environments_reward_is_1_for_each_goal():
    env = scripted([Moment(x=1.0), Moment(x=0.7), Moment(), Moment()], reward="task")
    assert rewards(play(env, 3, goal=(0.0, 0.0))) == [0.0, 1.0, 0.0]


def test_end_on_goal_ends_the_episode_at_the_goal_and_keeps_it():
    env = scripted([Moment(x=1.0), Moment()], end_on_goal=True)
    given = play(env, 1, goal=(0.0, 0.0))[0]
    assert given["terminated"].item()
    assert not given["truncated"].item()
    assert given["reward"].item() == 100.0
    assert bare(env).goal.tolist() == [[0.0, 0.0]]


def test_progress_pays_0_3_times_1_5_a_metre_from_the_first_step_on():
    assert rewards(play(scripted(moving(2, speed=0.04)), 2)) == pytest.approx([0.04 * 0.3 * 1.5] * 2, abs=1e-5)


def test_going_away_from_the_goal_while_facing_it_costs_as_much():
    assert rewards(play(scripted(moving(1, speed=-0.04)), 1)) == pytest.approx([-0.04 * 0.3 * 1.5], abs=1e-5)


@pytest.mark.parametrize(("change", "paid"), [(0.0009, False), (-0.0009, False), (0.0011, True), (-0.0011, True)])
def test_a_change_of_0_001_m_or_less_costs_the_idle_penalty_times_1_5(change, paid):
    reward = play(scripted(moving(1, speed=change)), 1, goal=(2.0, 0.0))[0]["reward"].item()
    assert reward == pytest.approx(change * 0.45 if paid else -0.03 * 1.5, abs=1e-6)


@pytest.mark.parametrize(("yaw", "paid"), [(0.0, True), (1.5, True), (-1.5, True), (1.6, False), (math.pi, False)])
def test_progress_counts_only_with_a_positive_heading_alignment(yaw, paid):
    reward = play(scripted(moving(1, speed=0.04, yaw=yaw)), 1)[0]["reward"].item()
    assert reward == pytest.approx(0.04 * 0.45 if paid else -0.045, abs=1e-5)


@pytest.mark.parametrize("v", [1.0, -1.0])
def test_the_velocity_bonus_is_0_0025_for_each_m_s_forward(v):
    components = play(scripted([Moment(v=v)]), 1)[0]["reward_components"]
    assert components["velocity"].item() == pytest.approx(0.0025 * v)


@pytest.mark.parametrize("w", [2.0, -2.0])
def test_the_turn_penalty_is_0_0015_for_each_rad_s_either_way(w):
    components = play(scripted([Moment(w=w)]), 1)[0]["reward_components"]
    assert components["turn"].item() == pytest.approx(-0.003)


@pytest.mark.parametrize(("reading", "collides"), [(0.3, False), (0.299, True), (-math.inf, True), (math.nan, False)])
def test_a_reading_below_0_3_m_is_a_collision_that_costs_0_5_and_nothing_else(reading, collides):
    scan = [5.0] * 31 + [reading]
    given = play(scripted([Moment(v=1.0, w=1.0, ranges=scan)]), 1)[0]
    assert given["outcome", "collision"].item() is collides
    assert (given["reward"].item() == -0.5) is collides
    assert not given["done"].item()


def test_progress_goes_on_during_a_collision():
    script = [Moment(), Moment(x=0.04, ranges=0.1), Moment(x=0.08)]
    assert rewards(play(scripted(script), 2)) == pytest.approx([-0.5, 0.04 * 0.45], abs=1e-5)


# -----------------------------------------------------------------------------------------------------------
# Endings, on scripts


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("axis", ["roll", "pitch"])
def test_beyond_1_48_rad_of_roll_or_pitch_the_rover_is_flipped(axis, sign):
    env = scripted(*([Moment(**{axis: sign * angle})] for angle in (1.479, 1.481, 1.56)))
    given = play(env, 1)[0]
    assert given["outcome", "flipped"].flatten().tolist() == [False, True, True]
    assert given["terminated"].flatten().tolist() == [False, True, True]


def test_a_rover_on_its_back_is_flipped():
    given = play(scripted([Moment(roll=3.1)], [Moment(pitch=3.1)]), 1)[0]
    assert given["outcome", "flipped"].all()


@pytest.mark.parametrize(("step", "reward"), [(1, 0.0), (500, 0.0), (501, -20.0), (502, -20.0)])
def test_a_flip_costs_20_after_step_500_and_nothing_before(step, reward):
    script = moving(step - 1)
    given = play(scripted([*script, Moment(x=script[-1].x, roll=2.0)]), step)[-1]
    assert given["terminated"].item()
    assert given["reward"].item() == reward


def test_more_than_15_steps_in_collision_are_a_jam_that_costs_20():
    given = play(scripted([Moment(), Moment(ranges=0.1)]), 16)
    assert rewards(given) == [-0.5] * 15 + [-20.0]
    assert phases(given) == [StepEvent.COLLISION] * 15 + [StepEvent.JAM]
    assert [td["terminated"].item() for td in given] == [False] * 15 + [True]
    assert given[-1]["outcome", "jammed"].item()
    assert given[-1]["outcome", "collision"].item()


def test_a_step_without_collision_starts_the_count_anew():
    near, free = Moment(ranges=0.1), Moment()
    given = play(scripted([free, *[near] * 15, free, *[near] * 16]), 32)
    assert [td["terminated"].item() for td in given] == [False] * 31 + [True]


def test_a_reset_starts_the_collision_count_anew():
    env = scripted([Moment(ranges=0.1)])
    play(env, 10)
    assert not any(td["done"].any() for td in play(env, 15))


def test_a_goal_reached_in_a_collision_pays_and_counts_as_a_step_in_collision():
    near, far = Moment(x=0.1, ranges=0.1), Moment(x=3.0, ranges=0.1)
    given = play(scripted([far, *[far] * 7, near, *[Moment(x=30.0, ranges=0.1)] * 8]), 16, goal=(0.0, 0.0))
    assert rewards(given) == [-0.5] * 7 + [100.0] + [-0.5] * 7 + [-20.0]


def test_leaving_the_bounds_costs_10_and_ends_the_episode():
    given = play(scripted([Moment(x=29.9), Moment(x=30.1)]), 1)[0]
    assert given["reward"].item() == -10.0
    assert given["terminated"].item()
    assert given["outcome", "phase"].item() == StepEvent.OUT_OF_BOUNDS


def test_600_positions_less_than_0_001_m_apart_are_stuck_and_cost_25():
    given = play(scripted([Moment()]), 600)
    assert [td["done"].item() for td in given] == [False] * 599 + [True]
    assert given[-1]["reward"].item() == -25.0
    assert given[-1]["outcome", "phase"].item() == StepEvent.STUCK
    assert rewards(given[:-1]) == [-0.045] * 599


def test_the_600_positions_of_the_stuck_window_span_599_displacements():
    # The position after the reset is not among them; those after step 1 and after step 600 are.
    def script(moves_at: int) -> list[Moment]:
        return [Moment(x=0.01 * (k >= moves_at)) for k in range(602)]

    given = play(scripted(script(1), script(2), script(600), script(601)), 600)
    assert given[-1]["outcome", "stuck"].flatten().tolist() == [True, False, False, True]
    assert not any(td["done"].any() for td in given[:-1])


@pytest.mark.parametrize(("moved", "stuck"), [(0.0009, True), (0.0011, False)])
def test_stuck_is_a_displacement_below_0_001_m(moved, stuck):
    given = play(scripted([Moment(), *[Moment()] * 29, Moment(x=moved)], task=TaskConfig(stuck_window=30)), 30)
    assert given[-1]["outcome", "stuck"].item() is stuck


def test_only_the_oldest_and_the_newest_position_count_for_stuck():
    excursion = [Moment(), Moment(), *[Moment(x=1.0)] * 28, Moment()]
    given = play(scripted(excursion, task=TaskConfig(stuck_window=30)), 30)
    assert given[-1]["outcome", "stuck"].item()


def test_the_stuck_window_slides():
    given = play(scripted(moving(10), task=TaskConfig(stuck_window=30)), 39)
    assert [td["done"].item() for td in given] == [False] * 38 + [True]


def test_the_position_history_does_not_survive_a_reset():
    env = scripted([Moment()], task=TaskConfig(stuck_window=30))
    play(env, 20)
    given = play(env, 30)
    assert [td["done"].item() for td in given] == [False] * 29 + [True]


def test_the_position_history_of_rows_that_are_not_active_does_not_move():
    history = PositionHistory(2, 3, CPU)
    active = torch.tensor([[True], [False]])
    for k in range(1, 4):
        steps = torch.tensor([[k], [1]])
        way = history.displacement(torch.full((2, 2), float(k)), steps, None if k == 1 else active)
    assert way[0].item() == pytest.approx(math.hypot(2, 2))
    assert way[1].item() == math.inf


@pytest.mark.parametrize(
    ("moment", "reward", "phase"),
    [
        (Moment(x=31.0, roll=2.0, ranges=0.1), 0.0, StepEvent.FLIP),
        (Moment(x=31.0, ranges=0.1), -20.0, StepEvent.JAM),
        (Moment(x=31.0), -10.0, StepEvent.OUT_OF_BOUNDS),
    ],
)
def test_the_first_ending_in_the_contracts_order_decides(moment, reward, phase):
    # Out of bounds all the time, stuck at the last step, and jammed there if it is in collision.
    near = [Moment(x=31.0, ranges=0.1)] * 15
    env = scripted([moment, *near, moment], task=TaskConfig(stuck_window=16))
    given = play(env, 16)[-1]
    assert given["outcome", "out_of_bounds"].item()
    assert given["outcome", "stuck"].item()
    assert given["outcome", "jammed"].item() is (moment.ranges == 0.1)
    assert given["outcome", "phase"].item() == phase
    assert given["reward"].item() == reward
    assert [float(v) for v in given["reward_components"].values() if v != 0] == [reward] * (reward != 0)


def test_an_ending_takes_the_goals_place():
    given = play(scripted([Moment(x=1.0), Moment(roll=2.0)]), 1, goal=(0.0, 0.0))[0]
    assert not given["outcome", "goal_reached"].item()
    assert given["reward"].item() == 0.0


# -----------------------------------------------------------------------------------------------------------
# Time limit, counters


def test_an_episode_is_truncated_at_2000_steps_by_default():
    given = play(scripted(moving(2000), reward="task"), 2000)
    assert [td["truncated"].item() for td in given] == [False] * 1999 + [True]
    assert given[-1]["done"].item()
    assert not given[-1]["terminated"].item()


@pytest.mark.parametrize("length", [1, 7])
def test_an_episode_is_truncated_at_its_length(length):
    given = play(scripted(moving(length), length=length), length)
    assert [td["truncated"].item() for td in given] == [False] * (length - 1) + [True]


def test_an_ending_at_the_time_limit_is_terminated():
    given = play(scripted([Moment(roll=2.0)], length=1), 1)[0]
    assert given["terminated"].item()
    assert given["done"].item()


def test_steps_count_the_episode_and_total_steps_the_rows_life():
    env = scripted(moving(3))
    play(env, 3)
    outcome = play(env, 2)[-1]["outcome"]
    assert (outcome["steps"].item(), outcome["total_steps"].item()) == (2, 5)


def test_after_a_reset_nothing_has_happened():
    env = scripted([Moment(ranges=0.1, roll=2.0)])
    play(env, 1)
    td = env.reset()
    assert not any(td["outcome", event].any() for event in EVENTS)
    assert td["outcome", "phase"].item() == StepEvent.NONE
    assert td["outcome", "steps"].item() == 0
    assert td["outcome", "progress"].item() == 0
    assert not td["done"].any()


# -----------------------------------------------------------------------------------------------------------
# The reward against the transcription


def test_scripts_of_every_kind_give_what_the_transcription_says():
    rng = np.random.default_rng(0)
    rows, steps = 24, 150

    def script() -> list[Moment]:
        x, y, near = *rng.uniform(-2, 2, 2), 0.0
        moments = []
        for _ in range(steps):
            if rng.random() < 0.9:
                x, y = np.clip(np.array((x, y)) + rng.normal(0, 0.3, 2), -32, 32)
            near = rng.uniform(0, 25) if rng.random() < 0.15 else near
            ranges = rng.uniform(0, 14, 50) + (near > 3) * 0.4
            ranges[rng.integers(50)] = rng.choice([math.inf, math.nan, -math.inf if near < 0.5 else 5.0])
            tilt = rng.normal(0, 0.3, 2) if rng.random() < 0.99 else rng.normal(0, 1.2, 2)
            v, w = rng.normal(0, 5, 2)
            moments.append(Moment(x, y, rng.normal(0, 5), *tilt, rng.uniform(-3.1, 3.1), v, w, ranges.tolist()))
        return moments

    scripts = [script() for _ in range(rows)]
    # Some rovers stand for a while, so that they are stuck.
    for k in range(0, rows, 3):
        scripts[k] = [scripts[k][0], *[scripts[k][1]] * 40, *scripts[k][2:]]
    world = World("small", Terrain.flat((8, 8)), spawn_range=AREA, bounds=((-4, 5), (-6, 4)))
    env = scripted(*scripts, world_n=world, lidar_beams=50, length=60, task=TaskConfig(stuck_window=20))

    def policy(td: TensorDict, _: RoverEnv, k: int) -> Tensor:
        return torch.from_numpy(rng.uniform(-1.5, 1.5, (rows, 2))).float() * torch.tensor([1.0, 2.0])

    seen = witness(env, world.bounds, steps, policy, length=60, stuck_window=20)
    check_witnessed(seen)
    assert {v.expected.decided_by for v in seen.verdicts} == set(NAME_OF_PHASE.values())
    assert any(v.truncated for v in seen.verdicts)


ROLLOUT_ROWS, ROLLOUT_STEPS, ROLLOUT_LENGTH = 8, 250, 150
EDGES = {"inspect": (-13.7, -20.0, 0.0), "moon": (9.5, 3.0, 0.0), "maze": (0.0, 0.0, 0.0)}
"""Poses near the bounds, facing out; the maze has walls in front of its bounds."""


def roam(td: TensorDict, env: RoverEnv, k: int) -> Tensor:
    """A policy a row: two seek the goal, two an obstacle, two act at random, one drives on, one sways."""
    angle = td["target"][:, 1]
    ranges, angles = env.rover_state.ranges, env.simulator.ray_angles
    nearest = angles[ranges.nan_to_num(posinf=99.0).argmin(-1)]
    nearest = torch.atan2(nearest.sin(), nearest.cos())
    generator = torch.Generator().manual_seed(k)
    action = (torch.rand(ROLLOUT_ROWS, 2, generator=generator) * 2 - 1) * torch.tensor([1.0, math.pi])
    action[:2, 0], action[:2, 1] = angle[:2].cos().clamp(min=0.2), angle[:2].clamp(-0.8, 0.8)
    action[2:4, 0], action[2:4, 1] = 0.8, nearest[2:4].clamp(-0.8, 0.8)
    action[6] = torch.tensor([1.0, 0.0])
    action[7] = torch.tensor([math.cos(k / 25), 1.5 * math.sin(k / 40)])
    return action


@pytest.fixture(scope="module", params=WORLD_NAMES)
def rollout(request) -> Witness:
    """2,000 steps of a world: 8 rovers, 250 steps each, with automatic resets."""
    name = request.param
    env = make_env(world_n=name, num_envs=ROLLOUT_ROWS, seed=11, length=ROLLOUT_LENGTH, lidar_beams=100)
    env.reset()
    state = bare(env).rover_state
    yaw = torch.tensor([contract.euler(q)[2] for q in state.orientation.tolist()])
    start = torch.cat((state.position[:, :2], yaw[:, None]), -1)
    goal = bare(env).goal
    # Goals 0.9 m straight ahead for the seekers.
    ahead = torch.stack((yaw.cos(), yaw.sin()), -1)
    goal[:2] = start[:2, :2] + 0.9 * ahead[:2]
    start[6] = torch.tensor(EDGES[name])
    table = contract.WORLDS[name]
    bounds = (table.too_far_away_x, table.too_far_away_y)
    seen = witness(env, bounds, ROLLOUT_STEPS, roam, start, goal, length=ROLLOUT_LENGTH)
    env.close()
    return seen


def test_recorded_rollouts_give_what_the_transcription_says(rollout):
    assert len(rollout.verdicts) == 2000
    check_witnessed(rollout)


def test_recorded_rollouts_hold_goals_collisions_endings_and_time_limits(rollout):
    decided = [v.expected.decided_by for v in rollout.verdicts]
    assert decided.count("goal") >= 2
    assert decided.count("collision") >= 15
    assert {"jam", "out_of_bounds"} & set(decided)
    assert any(v.truncated for v in rollout.verdicts)
    assert decided.count("dense") > 1000


def test_recorded_rollouts_keep_the_goal_until_it_is_reached_and_then_set_one_1_m_away_or_more(rollout):
    x_range, y_range = bare(rollout.env).worlds[0].goal_range
    for v in rollout.verdicts:
        if v.expected.decided_by != "goal":
            assert v.goal == v.goal_before
        else:
            assert math.dist(v.goal, v.position) >= 1 - 1e-5
            assert x_range[0] <= v.goal[0] <= x_range[1]
            assert y_range[0] <= v.goal[1] <= y_range[1]


def test_recorded_rollouts_total_is_the_sum_of_the_components(rollout):
    for v in rollout.verdicts:
        assert v.reward == pytest.approx(sum(v.components.values()), abs=1e-5)


# -----------------------------------------------------------------------------------------------------------
# Endings on Bullet


def drive(world: World, start: tuple, action: tuple, steps: int, **settings) -> list[TensorDict]:
    """The steps of one rover up to the end of its episode, the end included."""
    env = make_env(world_n=world, lidar_beams=32, seed=0, **settings)
    td = env.reset(start=pairs(start), goal=pairs((50.0, 50.0)))
    given = []
    for _ in range(steps):
        td["action"] = pairs(action)
        td = env.step(td)["next"]
        given.append(td)
        if td["done"].any():
            break
    env.close()
    return given


def test_a_rover_that_drives_out_of_bounds_ends_there():
    world = World("narrow", Terrain.flat((8, 8)), spawn_range=AREA, bounds=((-3, 3), (-3, 3)))
    given = drive(world, (2.7, 0.0, 0.0), (1.0, 0.0), 20)
    assert phases(given)[-1] == StepEvent.OUT_OF_BOUNDS
    assert given[-1]["reward"].item() == -10.0
    assert given[-1]["pose"][0, 0] > 3.0
    assert given[-2]["pose"][0, 0] <= 3.0


def test_a_rover_that_drives_into_a_wall_jams_there():
    walls = [box((3.1, 0, 1), (0.2, 6, 2)), box((-3.1, 0, 1), (0.2, 6, 2)), box((0, 3.1, 1), (6, 0.2, 2))]
    world = World("room", Terrain.flat((8, 8)), walls, spawn_range=AREA)
    given = drive(world, (2.3, 0.0, 0.0), (0.5, 0.0), 60)
    assert phases(given)[-16:] == [StepEvent.COLLISION] * 15 + [StepEvent.JAM]
    assert set(phases(given)[:-16]) == {StepEvent.DENSE}
    assert given[-1]["reward"].item() == -20.0


def test_a_rover_that_stands_still_is_stuck():
    given = drive(meadow(), (0.0, 0.0, 0.0), (0.0, 0.0), 40, task=TaskConfig(stuck_window=30))
    assert len(given) == 30
    assert phases(given)[-1] == StepEvent.STUCK
    assert given[-1]["reward"].item() == -25.0


@lru_cache
def cliff() -> World:
    """Ground 2 m high that ends a little before x = 0."""
    heights = np.zeros((25, 25))
    heights[:, :12] = 2.0
    return World("cliff", Terrain(heights, 0.25), spawn_range=((-2.5, -1.5), (-1.0, 1.0)))


@pytest.mark.parametrize(("grace", "reward"), [(500, 0.0), (1, -20.0)])
def test_a_rover_that_falls_over_the_edge_of_a_cliff_flips(grace, reward):
    config = RewardConfig(flip_grace_steps=grace)
    given = drive(cliff(), (-0.25, 0.0, math.pi / 2), (0.5, 0.0), 40, reward=config)
    assert len(given) > 1
    assert phases(given)[-1] == StepEvent.FLIP
    assert given[-1]["reward"].item() == reward
    pitch, roll, _ = given[-1]["imu"][0].tolist()
    assert contract.is_flipped(roll, pitch)


# -----------------------------------------------------------------------------------------------------------
# Held rows, partial resets, bad actions


def act(k: int, rows: int) -> Tensor:
    generator = torch.Generator().manual_seed(k)
    return torch.rand(rows, 2, generator=generator) - torch.tensor([0.0, 0.5])


def test_held_rows_keep_observation_and_counters_get_no_reward_and_do_not_move():
    env = scripted(moving(9, speed=0.1), moving(9, speed=0.1))
    td = play(env, 3)[-1].clone()
    before = td.clone()
    td.update({"action": pairs((1.0, 0.5), 2), "_step": torch.tensor([True, False])})
    after = env.step(td)["next"]
    for key in OBSERVATION:
        assert torch.equal(after[key][1], before[key][1])
    for name in before["outcome"].keys():  # noqa: SIM118
        if name != "phase":
            assert torch.equal(after["outcome", name][1], before["outcome", name][1])
    assert after["outcome", "phase"].flatten().tolist() == [StepEvent.DENSE, StepEvent.NONE]
    assert after["outcome", "steps"].flatten().tolist() == [4, 3]
    assert after["reward"][1].item() == 0.0
    assert all(component[1].item() == 0.0 for component in after["reward_components"].values())
    assert after["reward"][0].item() > 0.0


def test_held_rows_stand_still_in_bullet_and_then_go_on_as_if_nothing_had_happened():
    rows, before, held_for, after = 4, 10, 5, 10
    active, held = [0, 2], [1, 3]
    mask = torch.tensor([True, False, True, False])
    env, twin = (make_env(world_n="maze", num_envs=rows, seed=3, lidar_beams=32) for _ in range(2))
    twin_td, twins = twin.reset(), []
    for k in range(before + after):
        twin_td["action"] = act(k, rows)
        twin_td = twin.step(twin_td)["next"]
        twins.append(twin_td)

    td = env.reset()
    for k in range(before):
        td["action"] = act(k, rows)
        td = env.step(td)["next"]
    state, observation = bare(env).rover_state.clone(), td.select(*OBSERVATION).clone()
    for k in range(before, before + held_for):
        td.update({"action": act(k, rows), "_step": mask})
        td = env.step(td)["next"]
        now = bare(env).rover_state
        for raw in ("position", "orientation", "ranges", "linear_velocity", "angular_velocity", "stamp"):
            assert torch.equal(getattr(now, raw)[held], getattr(state, raw)[held])
        assert (td.select(*OBSERVATION)[held] == observation[held]).all()
        assert not td["reward"][held].any()
        assert td["outcome", "phase"][held].eq(StepEvent.NONE).all()
        # The other rows do not notice.
        assert (td.select(*OBSERVATION, "reward")[active] == twins[k].select(*OBSERVATION, "reward")[active]).all()
    assert td["outcome", "steps"].flatten().tolist() == [15, 10, 15, 10]

    # The held rows now do what their twins did, but for contacts that the solver has to find again.
    for k in range(before, before + after):
        td["action"] = act(k, rows)
        td = env.step(td)["next"]
        late, early = td[held], twins[k][held]
        tolerance = 1e-3 if k == before else 1e-2
        torch.testing.assert_close(late["pose"], early["pose"], atol=tolerance, rtol=0)
        torch.testing.assert_close(late["imu"], early["imu"], atol=2e-2, rtol=0)
        assert torch.equal(late["outcome", "steps"], early["outcome", "steps"])
    env.close()
    twin.close()


def test_a_done_row_that_is_held_stays_done():
    env = scripted(moving(9), [Moment(), Moment(roll=2.0)])
    td = play(env, 1)[-1].clone()
    td.update({"action": pairs((0.0, 0.0), 2), "_step": torch.tensor([True, False])})
    after = env.step(td)["next"]
    assert after["terminated"].flatten().tolist() == [False, True]
    assert after["done"].flatten().tolist() == [False, True]
    assert after["outcome", "flipped"].flatten().tolist() == [False, True]


def test_a_partial_reset_leaves_the_other_rows_as_they_are():
    env = scripted(moving(9, speed=0.1, ranges=0.1), moving(9, speed=0.1, ranges=0.1))
    td = play(env, 5)[-1].clone()
    goal = bare(env).goal
    td["_reset"] = torch.tensor([[True], [False]])
    after = env.reset(td.clone())
    assert after["outcome", "steps"].flatten().tolist() == [0, 5]
    for key in OBSERVATION:
        assert torch.equal(after[key][1], td[key][1])
    assert torch.equal(bare(env).goal[1], goal[1])
    # Ten more steps in collision make 15 for the second row; one more is its jam.
    for k in range(11):
        after["action"] = pairs((0.0, 0.0), 2)
        after = env.step(after)["next"]
        assert after["terminated"].flatten().tolist() == [False, k == 10]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_an_action_that_is_not_finite_raises_and_names_the_row(bad):
    env = scripted([Moment()], [Moment()])
    td = env.reset()
    td["action"] = torch.tensor([[0.0, 0.0], [0.0, bad]])
    with pytest.raises(ValueError, match=r"finite.*rows \[1\]"):
        env.step(td)


def test_an_action_of_the_wrong_shape_raises_and_names_the_right_one():
    env = scripted([Moment()], [Moment()], reward="task")
    td = env.reset()
    td["action"] = torch.zeros(2, 3)
    with pytest.raises(ValueError, match=r"shape \(2, 2\)"):
        env.step(td)


def test_a_start_or_goal_of_the_wrong_shape_or_not_finite_raises():
    env = scripted([Moment()], reward="task")
    with pytest.raises(ValueError, match="goal must be finite"):
        env.reset(goal=torch.zeros(2, 2))
    with pytest.raises(ValueError, match="start must be finite"):
        env.reset(start=torch.tensor([[0.0, 0.0, math.nan]]))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"world_n": "mars"}, "inspect.*maze.*moon"),
        ({"backend": "gazebo"}, "bullet"),
        ({"num_envs": 0}, "num_envs"),
        ({"length": 0}, "length"),
        ({"lidar_points": 0}, "lidar_points"),
        ({"lidar_beams": 31}, "lidar_beams"),
        ({"max_lidar_range": 0.0}, "max_lidar_range"),
    ],
)
def test_a_setting_out_of_its_range_raises_and_says_what_is_allowed(settings, words):
    with pytest.raises(ValueError, match=words):
        RoverEnv(**{"world_n": meadow(), **settings})


def test_a_step_before_the_first_reset_raises():
    env = scripted([Moment()], reward="task")
    with pytest.raises(RuntimeError, match=r"reset\(\)"):
        env.step(TensorDict(action=torch.zeros(1, 2), batch_size=[1]))


# -----------------------------------------------------------------------------------------------------------
# Random draws


def test_draws_are_the_same_in_a_batch_of_any_size():
    many = random_bits(episode_keys(row_keys(7, 300, CPU), torch.full((300, 1), 4)), 2, 5, 6)
    for rows in (1, 16, 299):
        few = random_bits(episode_keys(row_keys(7, rows, CPU), torch.full((rows, 1), 4)), 2, 5, 6)
        assert torch.equal(few, many[:rows])


@pytest.mark.parametrize("seed", [0, 1, 12345, 2**31, 2**63 - 5, -4])
def test_row_i_seeded_s_is_row_0_seeded_s_plus_i(seed):
    keys = row_keys(seed, 9, CPU)
    assert keys.flatten().tolist() == [row_keys(seed + i, 1, CPU).item() for i in range(9)]


def test_seeds_episodes_streams_draws_and_lanes_all_give_other_numbers():
    bits = [
        random_bits(episode_keys(row_keys(seed, 1, CPU), torch.tensor([[episode]])), stream, draw, 4)
        for seed, episode, stream, draw in product(range(5), range(5), range(3), range(5))
    ]
    numbers = torch.cat(bits).flatten()
    assert len(numbers.unique()) == len(numbers)


def draws(kind: str, count: int = 20_000) -> Tensor:
    """Random bits that differ in one of what they depend on."""
    one, numbers = torch.ones(1, 1, dtype=torch.int64), torch.arange(count)[:, None]
    row = row_keys(0, 1, CPU)
    if kind == "row":
        return random_bits(episode_keys(row_keys(0, count, CPU), one), 0, 0, 1)
    if kind == "episode":
        return random_bits(episode_keys(row.expand(count, 1), numbers), 0, 0, 1)
    if kind == "draw":
        return random_bits(row.expand(count, 1), 1, numbers, 1)
    return random_bits(row, 1, 0, count).T


@pytest.mark.parametrize("kind", ["row", "episode", "draw", "lane"])
def test_draws_are_uniform_and_neighbours_are_independent(kind):
    bits = draws(kind).flatten()
    unit = to_unit(bits)
    index = to_index(bits, torch.tensor(40))
    assert unit.dtype == torch.float32
    assert unit.min() >= 0
    assert unit.max() < 1
    assert index.min() == 0
    assert index.max() == 39
    assert chisquare(np.histogram(unit, 50, (0, 1))[0]).pvalue > 1e-3
    assert chisquare(torch.bincount(index, minlength=40)).pvalue > 1e-3
    # Pairs of neighbours, and the index beside the number drawn from the same bits.
    for a, b in ((unit[:-1], unit[1:]), (unit, (index + 0.5) / 40)):
        assert chisquare(np.histogram2d(a, b, 10, ((0, 1), (0, 1)))[0].flatten()).pvalue > 1e-3


def test_every_bit_of_a_draw_is_as_often_1_as_0():
    bits = draws("row").flatten()
    ones = torch.stack([((bits >> place) & 1).float().mean() for place in range(64)])
    assert (ones - 0.5).abs().max() < 5 * 0.5 / math.sqrt(len(bits))


def test_row_i_of_an_environment_seeded_s_is_the_environment_seeded_s_plus_i():
    batch = make_env(world_n="maze", num_envs=3, seed=5, lidar_beams=32)
    single = make_env(world_n="maze", seed=7, lidar_beams=32)
    td, alone = batch.reset(), single.reset()
    for k in range(10):
        for key in OBSERVATION:
            assert torch.equal(td[key][2:], alone[key])
        assert torch.equal(bare(batch).goal[2:], bare(single).goal)
        td["action"] = act(k, 3)
        alone["action"] = td["action"][2:]
        td, alone = batch.step(td)["next"], single.step(alone)["next"]
        assert torch.equal(td["reward"][2:], alone["reward"])
    batch.close()
    single.close()


def test_the_same_seed_gives_the_same_episodes_and_another_seed_others():
    def goals(env: EnvBase) -> list[list[float]]:
        return [(env.reset(), bare(env).goal[0].tolist())[1] for _ in range(3)]

    first, second, third = (scripted([Moment()], seed=seed) for seed in (1, 1, 2))
    episodes = goals(first)
    assert episodes == goals(second)
    assert len({tuple(goal) for goal in episodes}) == 3
    assert episodes != goals(third)
    third.set_seed(1)
    assert episodes == goals(third)
