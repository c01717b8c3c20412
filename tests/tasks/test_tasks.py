"""The tasks of the package: what each states, its test, its learners, and its Gymnasium ID."""

from __future__ import annotations

import ast
import re
from dataclasses import fields, replace
from importlib import import_module
from pathlib import Path

import gymnasium
import pytest
from gymnasium.utils.env_checker import check_env

from rover_rl import EnvConfig, RewardConfig, Task, get_task, make_env
from rover_rl.algos.config import task_config
from rover_rl.cli import main
from rover_rl.envs.config import TaskConfig
from rover_rl.envs.parts import BUILT_IN_TASKS
from rover_rl.names import Name
from rover_rl.tasks import task_names

CONTRACT = ("inspect", "moon", "maze")
TASKS = {name: get_task(name) for name in task_names()}
FOLDER = Path(import_module("rover_rl.tasks").__file__ or "").parent
LONGEST = 120
ALLOWED = {"__future__", "math", "rover_rl.envs.config", "rover_rl.tasks.task"}


def source(name: str) -> tuple[str, ast.Module]:
    text = (FOLDER / f"{name.replace('-', '_')}.py").read_text()
    return text, ast.parse(text)


def stated(tree: ast.Module, kind: str) -> set[str]:
    """Names of the arguments of the only call of ``kind`` in the task."""

    def calls(of: str, within: ast.AST) -> list[ast.Call]:
        return [node for node in ast.walk(within) if isinstance(node, ast.Call) and getattr(node.func, "id", "") == of]

    (task,) = calls("Task", tree)
    (call,) = calls(kind, task)
    assert not call.args
    return {keyword.arg or "" for keyword in call.keywords}


def worlds(names: str | tuple[str, ...]) -> list[Name]:
    return [Name.parse(name) for name in ((names,) if isinstance(names, str) else names)]


def test_there_are_the_tasks_of_the_package_from_easy_to_hard() -> None:
    assert [*TASKS] == [*BUILT_IN_TASKS]
    assert {path.stem for path in FOLDER.glob("*.py")} - {"__init__", "task"} == {
        name.replace("-", "_") for name in TASKS
    }
    assert len({task.gym_id for task in TASKS.values()}) == len(TASKS) == 11
    for name, task in TASKS.items():
        assert task.name == name
        assert task.reason.endswith(".")


@pytest.mark.parametrize("name", TASKS)
def test_a_file_is_short_and_states_every_number(name: str) -> None:
    text, tree = source(name)
    assert len(text.splitlines()) <= LONGEST
    imports = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    imports |= {each.name for node in ast.walk(tree) if isinstance(node, ast.Import) for each in node.names}
    assert imports <= ALLOWED
    env = TASKS[name].env
    reward, ends = env.contract_reward, env.task
    # Distances of penalties that are off, and what a collision costs where the first one ends the episode.
    unused = {
        f"{kind}_distance" for kind in ("clearance", "intrusion", "risk") if not getattr(reward, f"{kind}_penalty")
    }
    unused |= set() if ends.collision_window else {"collision_penalty"}
    paid = {one.name for one in fields(RewardConfig) if getattr(reward, one.name)} - unused
    assert paid <= stated(tree, "RewardConfig")
    # The threshold is one of lidar readings.
    threshold = {"collision_threshold"} if ends.collision_from == "contact" else set()
    assert {one.name for one in fields(TaskConfig)} - threshold <= stated(tree, "TaskConfig")
    assert {"points", "beams", "max_range"} <= stated(tree, "LidarConfig")
    assert "kind" in stated(tree, "ActionConfig")
    assert {"world", "robot", "length", "backend"} <= stated(tree, "EnvConfig")
    if env.action.kind == "heading":
        assert stated(tree, "HeadingGains") == {"kp", "ki", "kd", "max_output"}
    assert {"observation", "test_world", "episodes", "seconds", "references", "learners"} <= stated(tree, "Task")


@pytest.mark.parametrize("name", TASKS)
def test_no_world_of_the_test_is_one_of_the_training(name: str) -> None:
    task = TASKS[name]
    trained, tested = worlds(task.env.world), worlds(task.test_world)
    if name in CONTRACT:
        # The worlds of the original environment, and 256 stored starts and goals.
        assert (task.env.world, task.test_world, task.episodes) == (name, name, 256)
        return
    assert all(each.is_range for each in (*trained, *tested))
    ranges = [[int(end) for end in re.findall(r":(\d+)-(\d+)", str(each))[0]] for each in (*trained, *tested)]
    assert max(last for _, last in ranges[: len(trained)]) < 10_000
    assert min(first for first, _ in ranges[len(trained) :]) == 50_000
    assert sum(map(len, tested)) == 64
    assert task.episodes == 4
    assert {each.part for each in tested} == {each.part for each in trained}


@pytest.mark.parametrize("name", CONTRACT)
def test_the_tasks_of_the_contract_have_its_numbers(name: str) -> None:
    contract, env = EnvConfig(), TASKS[name].env
    assert env.contract_reward == contract.contract_reward
    assert replace(env.task, collision_threshold=None) == contract.task
    assert env.task.collision_threshold == 0.3
    assert (env.lidar, env.heading_gains, env.length) == (contract.lidar, contract.heading_gains, 2000)
    assert env.bounded_action == contract.bounded_action
    ours = replace(env, world=contract.world, backend=contract.backend, action=contract.action, task=contract.task)
    assert ours == contract


@pytest.mark.parametrize("name", TASKS)
def test_the_environment_has_what_a_policy_reads(name: str) -> None:
    task = TASKS[name]
    # Loading all robots of the family takes seconds.
    fewer = {"robot": "any:0-7"} if name == "any-robot" else {}
    env = make_env(task=name, num_envs=2, seed=0, **fewer)
    td = env.rollout(2)
    for entry in task.observation:
        assert td[entry].isfinite().all()
    assert env.config == replace(task.env, num_envs=2, seed=0, **fewer)
    env.close()
    test = task.test_env
    assert test.length == round(task.seconds / test.control_dt)
    assert (test.task.collision_from, test.task.collision_window, test.end_on_goal) == ("contact", 0, True)


@pytest.mark.parametrize("name", TASKS)
def test_each_learner_can_begin(name: str) -> None:
    task = TASKS[name]
    assert sorted(task.learners) == ["ppo", "ppo-gru", "sac"]
    for learner in task.learners:
        config = task_config(name, learner)
        config.check()
        assert config.network.observation == task.observation
        assert config.algo == ("sac" if learner == "sac" else "ppo")
        assert (config.network.memory == "gru") == (learner == "ppo-gru")
        assert config.env.world == task.env.world


def test_settings_override_those_of_a_task() -> None:
    config = make_env(task="mazes", lidar_points=16, world="maze:1", action="twist", num_envs=1).config
    task = TASKS["mazes"].env
    assert config.lidar == replace(task.lidar, points=16)
    assert config.action == replace(task.action, kind="twist")
    assert config == replace(task, lidar=config.lidar, action=config.action, world="maze:1")
    with pytest.raises(ValueError, match=r"task mazes has the learners \['ppo-gru', 'ppo', 'sac'\], got 'dqn'"):
        task_config("mazes", "dqn")
    assert task_config("mazes", "ppo", gamma=0.5).algorithm.gamma == 0.5


@pytest.mark.parametrize(("name", "shape"), [("mazes", (145,)), ("race", (189,))])
def test_gymnasium_accepts_the_environment_of_a_task(name: str, shape: tuple[int]) -> None:
    env = gymnasium.make(TASKS[name].gym_id)
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.shape == shape
    assert env.unwrapped.base_env.config.world == TASKS[name].env.world
    env.close()


def test_a_task_is_checked() -> None:
    good = {
        "name": "mine",
        "reason": "It is mine.",
        "observation": ("lidar",),
        "env": EnvConfig(world="maze:0-9"),
        "test_world": "maze:50000-50001",
    }
    assert Task(**good).gym_id == "rover_rl/Mine-v0"
    wrong = {
        "seeds from 10,000|10000": {"env": EnvConfig(world="maze:10000-10001")},
        "test_world must be a range of seeds where the training has one": {"test_world": "maze:3"},
        "learners must name at least one": {"learners": {}},
    }
    for message, change in wrong.items():
        with pytest.raises(ValueError, match=message):
            Task(**good | change)


def test_the_command_lists_draws_and_describes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    # Drawing all takes seconds.
    monkeypatch.setattr("rover_rl.cli.tasks.task_names", lambda: ["mazes", "race"])
    assert main(["tasks"]) == 0
    listed = capsys.readouterr().out
    assert [line.split()[0] for line in listed.splitlines()[:2]] == ["mazes", "race"]
    assert (tmp_path / "tasks.png").stat().st_size > 10_000
    assert main(["tasks", "hills"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    task = TASKS["hills"]
    for part in (
        *(
            task.reason,
            "a policy reads heights, visits, imu, target, velocities",
            "worlds hills:0-299@0.2-1",
            "goal_reward=100",
        ),
        *("general_penalty=-30", "collision_window=0", "friction=(0.5, 1)", "length 1,200 steps of 50 ms"),
        *("hills:50000-50063@0.5-1, 4 episodes in each", "the goal within 60 s", "rover_rl/Hills-v0"),
        *("rover-rl train hills --learner sac (algo=sac, gamma=0.98)", "evaluate hills scripted gridplanner dwa"),
    ):
        assert part in text
    assert "collision_penalty" not in text
    Path("mine.png").write_text("mine")
    assert main(["tasks", "--out", "mine.png"]) == 2
    assert "rover-rl did not make it" in capsys.readouterr().err
    assert main(["tasks", "hillz"]) == 2
    assert "unknown task 'hillz', perhaps 'hills'" in capsys.readouterr().err
