"""Comparison of an environment with the transcription of the contract, step by step and row by row."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl.envs.task import StepEvent
from tests.envs import transcription as contract
from tests.envs.contract.scripted_env import OBSERVATION, assert_same_angle, bare

NAME_OF_PHASE = {event: event.name.lower() for event in StepEvent if StepEvent.FLIP <= event <= StepEvent.DENSE}


@dataclass
class Verdict:
    """One step of one row: what the environment returned and what the contract requires."""

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
    dt: float
    expected: contract.Step
    expected_total_steps: int


class Witness:
    """Runs the transcription beside an environment, one rover per row.

    The transcription, whose further arguments are ``settings``, receives only raw sensor values and the goals that the
    environment draws.

    Attributes:
        first_observations: actual and expected observation after each reset of a row.
        verdicts: actual and expected result of each step of each row.
    """

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
        speeds = raw.linear_velocity.flatten().tolist(), raw.angular_velocity.flatten().tolist()
        places = raw.position.tolist(), raw.orientation.tolist(), bare(self.env).scan.tolist()
        columns = zip(*places, *speeds, raw.dt.flatten().tolist(), strict=True)
        return [contract.Reading(*p, *contract.euler(q), ranges, v, w, dt) for p, q, ranges, v, w, dt in columns]

    def reset(self, td: TensorDict, rows: list[int]) -> None:
        readings, goals = self.readings(), bare(self.env).goal.tolist()
        for row in rows:
            self.rovers[row].reset(readings[row], tuple(goals[row]))
            self.first_observations.append((observed(td, row), self.rovers[row].observation()))

    def step(self, td: TensorDict) -> TensorDict:
        """Steps the environment with the action in ``td`` and records the results."""
        actions, goals_before = td["action"].tolist(), bare(self.env).goal.tolist()
        expected_commands = [rover.command(actions[row]) for row, rover in enumerate(self.rovers)]
        td = self.env.step(td)
        after, readings, goals = td["next"], self.readings(), bare(self.env).goal.tolist()
        for row, rover in enumerate(self.rovers):
            expected = rover.step(readings[row], tuple(goals[row]))
            self.verdicts.append(
                Verdict(
                    row=row,
                    observation=observed(after, row),
                    expected_observation=rover.observation(),
                    command=self.commands[row],
                    expected_command=expected_commands[row],
                    outcome={name: value[row].item() for name, value in after["outcome"].items()},
                    components={n: v[row].item() for n, v in after["reward_components"].items()},
                    reward=after["reward"][row].item(),
                    terminated=after["terminated"][row].item(),
                    truncated=after["truncated"][row].item(),
                    done=after["done"][row].item(),
                    goal_before=tuple(goals_before[row]),
                    goal=tuple(goals[row]),
                    position=(readings[row].x, readings[row].y),
                    dt=readings[row].dt,
                    expected=expected,
                    expected_total_steps=rover.total_steps,
                )
            )
        return td


def observed(td: TensorDict, row: int) -> dict[str, list[float]]:
    """The observation of one row."""
    return {key: td[key][row].tolist() for key in OBSERVATION}


def witness(env: EnvBase, bounds: tuple, steps: int, policy, start=None, goal=None, **settings: int) -> Witness:
    """Runs ``steps`` steps of ``policy`` with automatic resets and records them."""
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


def assert_same_observation(actual: dict[str, list[float]], expected: dict[str, list[float]]) -> None:
    for key, tolerance in (("lidar", 1e-6), ("pose", 1e-5), ("velocities", 1e-5)):
        # pytest.approx takes most of the time of a test with thousands of steps.
        pairs = zip(actual[key], expected[key], strict=True)
        assert all(abs(a - b) <= tolerance for a, b in pairs), (key, actual[key], expected[key])
    for angle, expected_angle in zip(actual["imu"], expected["imu"], strict=True):
        assert_same_angle(angle, expected_angle)
    assert actual["target"][0] == pytest.approx(expected["target"][0], abs=1e-5)
    assert_same_angle(actual["target"][1], expected["target"][1], 1e-5 + 1e-5 / max(expected["target"][0], 1e-3))


def check_witnessed(seen: Witness) -> None:
    """Asserts that the environment returned what the transcription requires, in every step."""
    close_calls = 0
    for actual, expected in seen.first_observations:
        assert_same_observation(actual, expected)
    for v in seen.verdicts:
        assert_same_observation(v.observation, v.expected_observation)
        assert v.dt == pytest.approx(contract.DT, abs=1e-6)
        assert v.command == pytest.approx(v.expected_command, abs=1e-4)
        assert {name: v.outcome[name] for name in contract.EVENTS} == v.expected.events
        assert not v.outcome["invalid_action"]
        assert NAME_OF_PHASE[v.outcome["phase"]] == v.expected.decided_by
        assert (v.terminated, v.truncated) == (v.expected.terminated, v.expected.truncated)
        assert v.done == (v.terminated or v.truncated)
        assert (v.outcome["steps"], v.outcome["total_steps"]) == (v.expected.steps, v.expected_total_steps)
        assert v.outcome["progress"] == pytest.approx(v.expected.progress, abs=1e-5)
        if v.expected.margin < 3e-6:
            # Float32 may give the distance reward where exact arithmetic gives the idle penalty.
            close_calls += 1
            continue
        assert v.components == pytest.approx(v.expected.components, abs=1e-5)
        assert v.reward == pytest.approx(v.expected.reward, abs=1e-5)
    assert close_calls <= len(seen.verdicts) // 200
