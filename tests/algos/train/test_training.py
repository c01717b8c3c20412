"""What PPO and SAC have in common: the folder, the end, and going on."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos import ppo, sac, training
from rover_rl.algos.config import UNLIMITED_STEPS, PPOConfig, TrainingConfig, read_config
from rover_rl.algos.evaluation.evaluate import draw_episodes, evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint, load_state, save_run
from rover_rl.algos.train.collectors import WorkerError
from rover_rl.algos.train.progress import ProgressLog, read_progress
from rover_rl.algos.train.run import TrainingSummary
from tests.full_disk import largest_file

PPO = training_config(
    "ppo",
    world="maze",
    total_steps=512,
    num_envs=4,
    workers=1,
    rollout_length=8,
    epochs=2,
    minibatch=16,
    hidden=(16,),
    snapshots=2,
)
SAC = training_config(
    "sac",
    world="maze",
    total_steps=512,
    num_envs=4,
    workers=1,
    rollout_length=2,
    gradient_steps=2,
    minibatch=8,
    learning_starts=24,
    buffer_size=64,
    hidden=(16,),
    snapshots=2,
)
BOTH = pytest.mark.parametrize("config", [PPO, SAC], ids=["ppo", "sac"])
LEARNER = {"ppo": ppo.PPOLearner, "sac": sac.SACLearner}


def train(config: TrainingConfig, folder: Path | None = None) -> TrainingSummary:
    run: Callable[..., TrainingSummary] = ppo.train_ppo if isinstance(config, PPOConfig) else sac.train_sac
    return run(config, folder)


def table(folder: Path) -> dict[str, list[float]]:
    return read_progress(folder / "progress.csv")


def equal(a: Any, b: Any) -> bool:
    """Whether two nested states are the same to the last bit."""
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(equal(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(equal, a, b))
    return a == b


@BOTH
def test_a_run_leaves_its_settings_its_progress_and_its_policies(config: TrainingConfig, tmp_path: Path) -> None:
    summary = train(with_settings(config, runs=str(tmp_path)))
    folder = summary.folder
    assert folder == tmp_path / f"{config.algo}-maze"
    assert (summary.steps, summary.interrupted) == (512, False)
    names = {file.name for file in folder.iterdir()}
    assert names - {"tensorboard"} == {"config.yaml", "progress.csv", "checkpoint.pt", "training_state.pt", "snapshots"}
    assert read_config(folder / "config.yaml") == with_settings(config, runs=str(tmp_path))
    columns = table(folder)
    taken = config.num_envs * config.decisions * config.repeat
    assert columns["steps"] == list(range(taken, 513, taken))
    assert columns["updates"] == list(range(1, 512 // taken + 1))
    assert columns["learning_rate"][0] == config.learning_rate > columns["learning_rate"][-1]
    assert sorted(file.name for file in (folder / "snapshots").iterdir()) == ["000000256.pt", "000000512.pt"]
    assert sum(summary.shares.values()) == pytest.approx(1)
    assert all(share >= 0 for share in summary.shares.values())


@BOTH
def test_the_policy_that_was_trained_can_be_evaluated(config: TrainingConfig, tmp_path: Path) -> None:
    checkpoint = Checkpoint.load(train(with_settings(config, runs=str(tmp_path))).checkpoint)
    assert (checkpoint.algorithm, checkpoint.steps) == (config.algo, 512)
    assert len(evaluate(checkpoint.make_actor(), draw_episodes("maze", 2, 0), seconds=1).endings) == 2


@BOTH
def test_the_same_seed_gives_the_same_weights_to_the_last_bit(config: TrainingConfig, tmp_path: Path) -> None:
    runs = [train(with_settings(config, runs=str(tmp_path), seed=seed)) for seed in (3, 3, 4)]
    first, again, other = (load_state(run.folder / "training_state.pt")["learner"] for run in runs)
    assert equal(first, again)
    assert not equal(first, other)


@BOTH
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_goes_on_where_it_was(
    config: TrainingConfig, number: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = train(with_settings(config, runs=str(tmp_path), name="whole"))
    handlers = [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)]
    learner = LEARNER[config.algo]
    update, calls = learner.update, []

    def stopped(self: Any, *args: Any) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 2:
            os.kill(os.getpid(), number)
        return update(self, *args)

    monkeypatch.setattr(learner, "update", stopped)
    first = train(with_settings(config, runs=str(tmp_path), name="stopped"))
    assert first.interrupted
    assert len(table(first.folder)["updates"]) == 2
    assert Checkpoint.load(first.checkpoint).steps == first.steps
    second = train(with_settings(config, runs=str(tmp_path), name="stopped"), first.folder)
    assert not second.interrupted
    counters = ("updates", "steps", "gradient_steps", "learning_rate")
    assert [table(second.folder)[key] for key in counters] == [table(whole.folder)[key] for key in counters]
    assert [signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)] == handlers


@BOTH
def test_the_learners_state_comes_back_exactly(config: TrainingConfig, tmp_path: Path) -> None:
    folder = train(with_settings(config, runs=str(tmp_path))).folder
    state = load_state(folder / "training_state.pt")
    learner = LEARNER[config.algo](config)  # type: ignore[arg-type]
    learner.load_state_dict(state["learner"])
    assert equal(learner.state_dict(), state["learner"])
    # A run that has had its budget is left as it is.
    again = train(with_settings(config, runs=str(tmp_path)), folder)
    assert again.steps == 512
    assert equal(load_state(folder / "training_state.pt")["learner"], state["learner"])


def test_a_full_replay_buffer_is_gone_on_with_at_the_same_place(tmp_path: Path) -> None:
    state = load_state(train(with_settings(SAC, runs=str(tmp_path))).folder / "training_state.pt")
    # 128 decisions went into 64 places.
    assert len(state["learner"]["memory"]["action"]) == 64
    assert state["learner"]["cursor"] == 0


def test_a_state_of_other_settings_is_refused(tmp_path: Path) -> None:
    folder = train(with_settings(PPO, runs=str(tmp_path))).folder
    with pytest.raises(ValueError, match="training state does not fit its settings"):
        train(with_settings(PPO, runs=str(tmp_path), hidden=(8,)), folder)


def test_a_run_that_was_killed_before_its_first_checkpoint_begins_anew(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = train(with_settings(PPO, total_steps=256, runs=str(tmp_path))).folder
    expected = table(folder)["loss_objective"]
    for name in ("checkpoint.pt", "training_state.pt"):
        (folder / name).unlink()
    capsys.readouterr()
    assert train(with_settings(PPO, total_steps=256, runs=str(tmp_path)), folder).steps == 256
    assert f"{folder} has no checkpoint yet: its training begins from the start\n" in capsys.readouterr().out
    assert table(folder)["loss_objective"] == expected


def test_a_checkpoint_without_its_training_state_is_not_written_over(tmp_path: Path) -> None:
    folder = train(with_settings(PPO, total_steps=128, runs=str(tmp_path))).folder
    (folder / "training_state.pt").unlink()
    with pytest.raises(ValueError, match=r"has a checkpoint, but no training_state\.pt to go on from; begin a new run"):
        train(with_settings(PPO, runs=str(tmp_path)), folder)
    assert Checkpoint.load(folder).steps == 128


def diverging(learner: type, monkeypatch: pytest.MonkeyPatch, after: int) -> None:
    """Puts a NaN into the critic's weights in the update ``after`` so many others."""
    update, calls = learner.update, []  # type: ignore[attr-defined]

    def diverge(self: Any, *args: Any) -> dict[str, float]:
        calls.append(1)
        learned = update(self, *args)
        if len(calls) > after:
            next(value for name, value in self.weights().items() if "critic" in name or "qvalue" in name).data.fill_(
                torch.nan
            )
        return learned

    monkeypatch.setattr(learner, "update", diverge)


@BOTH
def test_a_training_that_diverges_keeps_its_last_good_checkpoint(
    config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = with_settings(config, runs=str(tmp_path), checkpoint_minutes=1e-9)
    diverging(LEARNER[config.algo], monkeypatch, after=2)
    each = config.num_envs * config.decisions * config.repeat  # type: ignore[attr-defined]
    with pytest.raises(FloatingPointError) as failure:
        train(config)
    folder = tmp_path / f"{config.algo}-maze"
    text = str(failure.value)
    assert text.startswith(f"training diverged after {3 * each} steps, with NaN or infinity in ")
    assert f"the last good checkpoint is {folder}/checkpoint.pt, of {2 * each} steps" in text
    assert text.endswith(f"rover-rl train --resume {folder} --learning-rate 0.0003")
    assert Checkpoint.load(folder).steps == load_state(folder / "training_state.pt")["steps"] == 2 * each
    assert max(int(file.stem) for file in (folder / "snapshots").iterdir()) <= 2 * each if config is PPO else True
    monkeypatch.undo()
    assert train(with_settings(config, learning_rate=3e-4), folder).steps == 512


def test_a_training_that_diverges_at_once_says_so(tmp_path: Path) -> None:
    # The NaN comes within the update, whose next gradient step fails by it.
    with pytest.raises(FloatingPointError, match="there is no checkpoint yet; begin a new run with a lower learning"):
        train(with_settings(PPO, learning_rate=1e30, runs=str(tmp_path)))
    assert not (tmp_path / "ppo-maze" / "checkpoint.pt").exists()


def test_a_state_with_a_nan_is_not_gone_on_with(tmp_path: Path) -> None:
    folder = train(with_settings(PPO, total_steps=128, runs=str(tmp_path))).folder
    state = load_state(folder / "training_state.pt")
    name = next(name for name in state["learner"]["loss"] if name.startswith("critic_network_params"))
    state["learner"]["loss"][name].fill_(torch.inf)
    save_run(folder, Checkpoint.load(folder), state)
    with pytest.raises(ValueError, match=rf"training_state\.pt holds NaN or infinity in the weights {name}: it cannot"):
        train(with_settings(PPO, runs=str(tmp_path)), folder)


def test_a_full_disk_ends_a_run_with_the_checkpoint_that_it_had(tmp_path: Path) -> None:
    config = with_settings(PPO, runs=str(tmp_path), snapshots=0)
    folder = train(with_settings(config, total_steps=256)).folder
    whole = {path.name: path.read_bytes() for path in folder.glob("*.pt")}
    with largest_file(7000), pytest.raises(OSError, match=f"File too large: '{folder}/"):
        train(config, folder)
    assert {path.name: path.read_bytes() for path in folder.glob("*.pt")} == whole
    assert not [path.name for path in folder.iterdir() if path.name.startswith(".")]
    assert train(config, folder).steps == 512


@pytest.mark.parametrize("kind", [OSError, SystemExit])
def test_what_was_learned_is_kept_where_nobody_reads_on(
    kind: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def closed(self: ProgressLog, share: float) -> None:
        raise kind

    monkeypatch.setattr(ProgressLog, "show", closed)
    with pytest.raises(kind):
        train(with_settings(PPO, runs=str(tmp_path)))
    assert load_state(tmp_path / "ppo-maze" / "training_state.pt")["updates"] == 1


def test_what_was_taken_after_the_last_state_is_taken_again(tmp_path: Path) -> None:
    folder = train(with_settings(PPO, runs=str(tmp_path))).folder
    progress = folder / "progress.csv"
    lines = progress.read_text().splitlines()
    # As a kill leaves it: a row that no state has, and half of another.
    progress.write_text("\n".join([*lines, lines[-1], lines[-1][:20]]))
    train(with_settings(PPO, runs=str(tmp_path), total_steps=1024), folder)
    assert table(folder)["updates"] == list(range(1, 9))


@pytest.mark.slow
def test_two_workers_share_the_rovers(tmp_path: Path) -> None:
    summary = train(with_settings(PPO, workers=2, runs=str(tmp_path)))
    assert table(summary.folder)["steps"][-1] == 512


@pytest.mark.slow
def test_sac_learns_from_one_worker_while_the_other_drives(tmp_path: Path) -> None:
    progress = table(train(with_settings(SAC, workers=2, runs=str(tmp_path))).folder)
    # Each batch is one worker's: two rovers, two decisions; and brings half of a round's gradient steps.
    assert progress["steps"] == list(range(16, 513, 16))
    assert progress["gradient_steps"] == [0.0] * 5 + [1.0] * 27


@BOTH
@pytest.mark.slow
def test_a_worker_that_dies_ends_the_run_with_a_checkpoint_and_its_last_words(
    config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    learner = LEARNER[config.algo]
    update, calls = learner.update, []

    def killing(self: Any, *args: Any) -> dict[str, float]:
        calls.append(1)
        if len(calls) == 3:
            worker = next(child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline()))
            worker.send_signal(signal.SIGSEGV)
        return update(self, *args)

    monkeypatch.setattr(learner, "update", killing)
    with pytest.raises(WorkerError, match=r"(?s)exit code -11.*Fatal Python error: Segmentation fault"):
        train(with_settings(config, workers=2, total_steps=UNLIMITED_STEPS, runs=str(tmp_path), name="dying"))
    folder = tmp_path / "dying"
    assert 3 <= load_state(folder / "training_state.pt")["updates"] == len(table(folder)["updates"])
    monkeypatch.setattr(learner, "update", update)
    steps = Checkpoint.load(folder).steps
    again = train(with_settings(config, workers=2, total_steps=steps + 128, runs=str(tmp_path), name="dying"), folder)
    assert again.steps == steps + 128
    assert not [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]


@BOTH
@pytest.mark.slow
def test_a_workers_own_error_is_told(config: TrainingConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # What cannot be simulated fails where it is simulated.
    monkeypatch.setattr(training, "get_world", lambda name: None)
    with pytest.raises((WorkerError, ValueError), match="unknown world 'mars'"):
        train(with_settings(config, world="mars", workers=2, runs=str(tmp_path)))


@BOTH
def test_one_policy_can_be_trained_in_several_worlds_at_once(config: TrainingConfig, tmp_path: Path) -> None:
    summary = train(with_settings(config, world=("inspect", "maze"), runs=str(tmp_path)))
    assert summary.folder.name == f"{config.algo}-inspect-maze"
    assert read_config(summary.folder / "config.yaml").worlds == ("inspect", "maze")
    assert Checkpoint.load(summary.checkpoint).config.worlds == ("inspect", "maze")


@BOTH
def test_policies_can_be_trained_in_warp(config: TrainingConfig, tmp_path: Path) -> None:
    pytest.importorskip("warp", reason="needs rover_rl[warp]")
    config = replace(
        config, world=("inspect", "maze"), backend="warp", workers=None, randomize=True, runs=str(tmp_path), name="warp"
    )
    summary = train(config)
    assert summary.steps == 512
    assert read_config(summary.folder / "config.yaml").workers == 1
    again = train(with_settings(config, total_steps=640), summary.folder)
    assert again.steps == 640


def test_each_worlds_guide_is_asked_about_its_own_rovers(tmp_path: Path) -> None:
    config = with_settings(
        PPO, world=("maze", "maze:1"), total_steps=128, imitation=1.0, path_reward=1.0, runs=str(tmp_path)
    )
    assert train(config).steps == 128


def test_imitation_makes_the_guides_actions_likelier(tmp_path: Path) -> None:
    folder = train(
        replace(
            PPO,
            total_steps=2048,
            imitation=1.0,
            epochs=30,
            hidden=(64,),
            anneal=False,
            world="moon",
            runs=str(tmp_path),
        )
    ).folder
    surprise = table(folder)["loss_objective"]
    assert sum(surprise[-4:]) < sum(surprise[:4]) - 1
    actor = Checkpoint.load(folder).make_actor()
    # The goal lies to the left, with nothing in the way: the guide turns left and drives.
    lidar, imu = torch.full((1, 32), 12.0), torch.zeros(1, 3)
    target, velocities = torch.tensor([[5.0, 0.8]]), torch.zeros(1, 2)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        seen = TensorDict({"lidar": lidar, "imu": imu, "target": target, "velocities": velocities}, batch_size=[1])
        assert (actor(seen)["action"] > 0.2).all()


def test_time_can_be_the_budget(tmp_path: Path) -> None:
    summary = train(with_settings(PPO, total_steps=UNLIMITED_STEPS, max_minutes=1e-6, runs=str(tmp_path)))
    assert len(table(summary.folder)["steps"]) == 1
    assert [file.name for file in (summary.folder / "snapshots").iterdir()] == ["000000128.pt"]
    assert not summary.interrupted


@BOTH
def test_errors_come_before_anything_is_written(config: TrainingConfig, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unknown world 'mars'"):
        train(with_settings(config, world="mars", runs=str(tmp_path)))
    with pytest.raises(ValueError, match="num_envs"):
        train(with_settings(config, num_envs=0, runs=str(tmp_path)))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_killed_run_goes_on_without_gap_or_duplicate(tmp_path: Path) -> None:
    """Ten times SIGKILL at any moment; after each, every file that is there can be read."""
    folder, moments = tmp_path / "sac-maze", random.Random(0)
    sizes = [
        "--num-envs",
        "4",
        "--workers",
        "1",
        "--hidden",
        "16",
        "--warmup",
        "24",
        "--minibatch",
        "8",
        "--gradient-steps",
        "2",
    ]
    begin = ["--algo", "sac", "--world", "maze", "--runs", str(tmp_path), "--snapshots", "10000000"]
    begin += ["--total-steps", "1000000000"]
    begin += [*sizes, "--checkpoint-minutes", "0.002"]
    for life in range(10):
        resumed = (folder / "config.yaml").is_file()
        process = start(["--resume", str(folder)] if resumed else begin)
        if life % 2:
            # In the midst of building worlds and networks.
            time.sleep(moments.uniform(0, 4))
        else:
            seen = rows(folder)
            wait_until(lambda seen=seen: rows(folder) > seen, process)
            time.sleep(moments.uniform(0, 1.5))
        process.kill()
        process.wait()
        if (folder / "training_state.pt").is_file():
            assert load_state(folder / "training_state.pt")["updates"] <= len(table(folder)["updates"])
        if (folder / "checkpoint.pt").is_file():
            Checkpoint.load(folder)
    reached = load_state(folder / "training_state.pt")["steps"]
    assert start(["--resume", str(folder), "--total-steps", str(reached + 160)]).wait() == 0
    columns = table(folder)
    assert columns["updates"] == list(range(1, len(columns["updates"]) + 1))
    assert columns["steps"] == [16 * update for update in columns["updates"]]
    assert columns["steps"][-1] == reached + 160
    assert columns["minutes"] == sorted(columns["minutes"])


def rows(folder: Path) -> int:
    return len(table(folder).get("updates", ())) if (folder / "progress.csv").is_file() else 0


def start(options: list[str]) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-c", "import sys; from rover_rl.cli import main; sys.exit(main())", "train", *options]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    latest = time.monotonic() + 120
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < latest
        time.sleep(0.05)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_gpu_that_is_not_there_is_told_of_in_words(tmp_path: Path) -> None:
    config = with_settings(PPO, backend="warp", device="cuda", runs=str(tmp_path))
    with pytest.raises(ValueError, match=r"device='cuda' is not available: PyTorch .* finds cpu$"):
        train(config)
    assert not list(tmp_path.iterdir())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@BOTH
def test_training_on_a_gpu_goes_on_where_it_was(config: TrainingConfig, tmp_path: Path) -> None:
    config = with_settings(config, backend="warp", device="cuda", runs=str(tmp_path))
    first = train(with_settings(config, total_steps=256))
    again = train(with_settings(config, total_steps=512, name=first.folder.name), first.folder)
    assert (first.steps, again.steps) == (256, 512)
    assert (
        len(evaluate(Checkpoint.load(again.checkpoint).make_actor(), draw_episodes("maze", 2, 0), seconds=1).endings)
        == 2
    )
