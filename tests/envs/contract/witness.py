"""Comparison of an environment with the transcription of the contract, step by step and row by row."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import EnvBase

from rover_rl.envs.task import StepEvent
from tests.envs import transcription as contract
from tests.envs.scripted import OBSERVATION, assert_same_angle, bare

NAME_OF_PHASE = {event: event.name.lower() for event in StepEvent if StepEvent.FLIP <= event <= StepEvent.DENSE}


@dataclass
class Verdict:
    """One step of one row: what the environment returned, and what the contract requires."""

    result: TensorDict
    command: list[float]
    reading: contract.Reading
    goal_before: tuple[float, float]
    goal: tuple[float, float]
    expected: contract.Step
    expected_command: tuple[float, float]

    @property
    def truncated(self) -> bool:
        return self.result["truncated"].item()


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

    def goals(self) -> list[tuple[float, float]]:
        return [(x, y) for x, y in bare(self.env).goal.tolist()]

    def reset(self, td: TensorDict, rows: list[int]) -> None:
        readings, goals = self.readings(), self.goals()
        for row in rows:
            self.rovers[row].reset(readings[row], goals[row])
            self.first_observations.append((td[row], self.rovers[row].observation()))

    def step(self, td: TensorDict) -> TensorDict:
        """Steps the environment with the action in ``td`` and records the results."""
        actions, before = td["action"].tolist(), self.goals()
        commands = [rover.command(action) for rover, action in zip(self.rovers, actions, strict=True)]
        td = self.env.step(td)
        readings, goals = self.readings(), self.goals()
        for row, rover in enumerate(self.rovers):
            told = td["next"][row], self.commands[row], readings[row], before[row], goals[row]
            self.verdicts.append(Verdict(*told, rover.step(readings[row], goals[row]), commands[row]))
        return td


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


def assert_same_observation(result: TensorDict, expected: dict[str, list[float]]) -> None:
    actual = {key: result[key].tolist() for key in OBSERVATION}
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
        expected = v.expected
        assert_same_observation(v.result, expected.observation)
        assert v.reading.dt == pytest.approx(contract.DT, abs=1e-6)
        assert v.command == pytest.approx(v.expected_command, abs=1e-4)
        outcome = {name: value.item() for name, value in v.result["outcome"].items()}
        assert {name: outcome[name] for name in contract.EVENTS} == expected.events
        assert not outcome["invalid_action"]
        assert NAME_OF_PHASE[outcome["phase"]] == expected.decided_by
        ended = [v.result[name].item() for name in ("terminated", "truncated", "done")]
        assert ended == [expected.terminated, expected.truncated, expected.terminated or expected.truncated]
        assert (outcome["steps"], outcome["total_steps"]) == (expected.steps, expected.total_steps)
        assert outcome["progress"] == pytest.approx(expected.progress, abs=1e-5)
        if expected.margin < 3e-6:
            # Float32 may give the distance reward where exact arithmetic gives the idle penalty.
            close_calls += 1
            continue
        components = {name: value.item() for name, value in v.result["reward_components"].items()}
        assert components == pytest.approx(expected.components, abs=1e-5)
        assert v.result["reward"].item() == pytest.approx(expected.reward, abs=1e-5)
    assert close_calls <= len(seen.verdicts) // 200
