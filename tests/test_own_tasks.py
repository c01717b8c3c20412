"""A task of a stranger's package with an action, a termination and an event, one file each, of ``docs/tasks.md``."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
import yaml

from rover_rl import get_task, make_env, register_action, register_event, register_task, register_termination
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.cli import main
from rover_rl.envs.parts import TASKS
from tests.pages import ROOT, blocks

TASK, ACTION = "my_package.task:TASK", "my_package.action:Arc"
TERMINATION, EVENT = "my_package.termination:Tilted(angle=0.5)", "my_package.event:Pull"
SMALL = ["--total-steps", "64", "--num-envs", "4", "--rollout-length", "4", "--hidden", "8", "--epochs", "1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The current folder, with the package."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "my_package").mkdir()
    page = blocks((ROOT / "docs" / "tasks.md").read_text(encoding="utf-8"), "python")
    files = {block.code.split('"""')[1]: block.code for block in page if block.code.startswith('"""my_package/')}
    assert [*files] == [f"my_package/{name}.py" for name in ("action", "termination", "event", "task")]
    for name, code in {"my_package/__init__.py": "", **files}.items():
        (folder / name).write_text(code)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [str(folder), *sys.path])
        yield folder
    for name in [name for name in sys.modules if name.startswith("my_package")]:
        del sys.modules[name]


@pytest.mark.slow
def test_the_task_is_described_trained_evaluated_and_filmed(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tasks", TASK, "--out", "crooked.png"]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for part in (ACTION, TERMINATION, EVENT, f"rover-rl train {TASK} --learner ppo-gru", "angle=0.5"):
        assert part in text
    assert main(["train", TASK, "--world", "maze:3", *SMALL]) == 0
    told = capsys.readouterr().out
    run = "runs/ppo-crooked"
    assert f"rover-rl evaluate {TASK} {run}" in told.replace("\n", " ")
    env = yaml.safe_load((folder / run / "config.yaml").read_text())["env"]
    assert (env["action"]["kind"], env["terminate"][0], env["events"]) == (ACTION, TERMINATION, [EVENT])
    checkpoint = Checkpoint.load(run)
    assert checkpoint.config.env.action.kind == ACTION
    drives = ["--count", "1", "--seconds", "0.5", "--world", "maze:50000"]
    assert main(["evaluate", TASK, run, "scripted", *drives]) == 0
    evaluation, reference = json.loads((folder / run / "evaluation.json").read_text())
    # The baselines steer as the contract does.
    assert (evaluation["env"]["action"]["kind"], reference["env"]["action"]["kind"]) == (ACTION, "heading")
    assert evaluation["env"]["terminate"][0] == reference["env"]["terminate"][0] == TERMINATION
    assert evaluation["env"]["events"] == reference["env"]["events"] == [EVENT]
    assert main(["film", run, "--out", "crooked.gif", "--seconds", "0.5", "--width", "80", "--height", "60"]) == 0
    assert min((folder / name).stat().st_size for name in ("crooked.gif", "crooked.png")) > 1000


@pytest.mark.slow
def test_the_parts_are_options_of_a_training_without_the_task(folder: Path) -> None:
    parts = ["--action", ACTION, "--terminate", TERMINATION, "no_progress", "--events", EVENT, "power_dips(rate=0.2)"]
    assert main(["train", "--world", "maze:3", *parts, *SMALL, "--name", "parts"]) == 0
    env = yaml.safe_load((folder / "runs" / "parts" / "config.yaml").read_text())["env"]
    assert env["terminate"] == [TERMINATION, "no_progress"]
    assert env["events"] == [EVENT, "power_dips(rate=0.2)"]
    assert main(["train", "--resume", "runs/parts", "--total-steps", "128"]) == 0


@pytest.mark.usefixtures("folder")
def test_the_task_is_one_of_gymnasium() -> None:
    env = gymnasium.make("rover_rl/Rover5Hz-v0", task=TASK)
    observation, _ = env.reset(seed=0)
    assert env.action_space.high.tolist() == [1.0, 2.0]
    assert observation in env.observation_space
    result = env.step(np.array([0.5, 0.0], np.float32))
    assert result[4]["steps"] == 4
    rovers = env.unwrapped.base_env
    assert rovers.config.world == "moon:0-99"
    env.close()
    vector = gymnasium.make_vec("rover_rl/Rover5Hz-v0", 3, "vector_entry_point", task=TASK, world="maze:3")
    vector.reset(seed=0)
    ended = [vector.step(vector.action_space.sample())[2] for _ in range(3)]
    assert np.shape(ended) == (3, 3)
    vector.close()


@pytest.mark.slow
def test_stable_baselines3_learns_the_task_and_its_file_is_evaluated(folder: Path) -> None:
    sb3 = pytest.importorskip("stable_baselines3")
    from rover_rl.envs.sb3 import SB3VecEnv

    rovers = make_env(task=TASK, num_envs=4, seed=0, world="maze:3", terminate="no_progress(seconds=0.3)")
    options = {"observation": get_task(TASK).observation, "scale_observations": True, "action_repeat": 4}
    envs = SB3VecEnv(rovers, **options)
    ends = []
    envs.reset()
    for _ in range(4):
        _, _, done, infos = envs.step(np.zeros((4, 2), np.float32))
        ends += [info for info in infos if "terminal_observation" in info]
        assert done.sum() == len([info for info in infos if info])
    # Rovers that stand do not get nearer, and this is no time limit.
    assert len(ends) == 8
    assert not any(info["TimeLimit.truncated"] for info in ends)
    model = sb3.PPO("MlpPolicy", envs, n_steps=8, batch_size=16, n_epochs=1, policy_kwargs={"net_arch": [8]})
    model.learn(32)
    assert model.num_timesteps == 32
    envs.close()
    model.save("sb3.zip")
    drives = ["--count", "1", "--seconds", "0.2", "--world", "maze:50000", "--action-repeat", "4", "--out", "sb3"]
    assert main(["evaluate", TASK, "sb3.zip", *drives]) == 0
    (evaluation,) = json.loads((folder / "sb3" / "evaluation.json").read_text())
    assert evaluation["env"]["action"]["kind"] == ACTION


@pytest.mark.usefixtures("folder", "own_registries")
def test_registered_parts_have_names() -> None:
    for register, name, part in (
        (register_action, "arc", ACTION),
        (register_termination, "tilted", "my_package.termination:Tilted"),
        (register_event, "pull", EVENT),
        (register_task, "crooked", TASK),
    ):
        register(name, part)
        with pytest.raises(ValueError, match=f"named '{name}' already exists"):
            register(name, "other:part")
    assert "crooked" in TASKS.names()
    env = make_env(
        task="crooked", world="maze:3", num_envs=2, action="arc", terminate=("tilted(angle=0.4)",), events="pull"
    )
    td = env.reset()
    td = env.step(td.set("action", torch.zeros(2, 2)))["next"]
    assert td["terminations", "tilted"].shape == (2, 1)
    assert get_task("crooked").gym_id == "rover_rl/Crooked-v0"


@pytest.mark.usefixtures("folder")
def test_a_mistake_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    mistakes = {
        "train my_package.task:TASKS": "has no 'TASKS'",
        "train my_package.action:Arc": "task must be one of ['inspect'",
        "train --action my_package.event:Pull": "or an Action class, got 'my_package.event:Pull'",
        "train --terminate my_package.event:Pull": "a termination must be a Termination",
        f"train {TASK} --learner sac": "has the learners ['ppo', 'ppo-gru'], got 'sac'",
        "train --learner sac": "--learner is one of those of a task",
        f"train --max-minutes 1 {TASK}": "name the task before the options",
        f"evaluate {TASK}": "name a policy",
        f"evaluate {TASK} scripted --env other.yaml": "--env is another environment than that of the task crooked",
    }
    for line, message in mistakes.items():
        assert main(line.split()) == 2, line
        error = capsys.readouterr().err
        assert message in error
        assert len(error.splitlines()) == 1
