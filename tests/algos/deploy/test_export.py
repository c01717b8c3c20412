from __future__ import annotations

import io
import json
import pickle
import random
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from rover_rl.algos.config import training_config
from rover_rl.algos.deploy import export as exporting
from rover_rl.algos.deploy.export import OnnxPolicy, export, random_observations
from rover_rl.algos.evaluation.episodes import draw_episodes, stored_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import actor_of
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.cli import main
from tests.algos.evaluation.drives import assert_alike
from tests.algos.policy.memories import recurrent_checkpoint

SAC = load_pretrained("moon-sac")
needs_onnx = pytest.mark.skipif(
    any(find_spec(name) is None for name in ("onnxscript", "onnxruntime")), reason="needs rover_rl[onnx]"
)


@pytest.fixture(scope="module", autouse=True)
def few_checks() -> Iterator[None]:
    """Exported policies are compared on 50 observations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "CHECKED", 50)
        yield


@pytest.fixture(scope="module")
def onnx_file(tmp_path_factory) -> Path:
    """What the command writes of SAC's policy."""
    folder, told = tmp_path_factory.mktemp("onnx"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(told):
        patch.chdir(folder)
        assert main(["export", "pretrained:moon-sac"]) == 0
    assert "moon-sac.onnx: acts as pretrained:moon-sac does" in told.getvalue()
    assert "reads" not in told.getvalue()
    return folder / "moon-sac.onnx"


def shapes(path: Path) -> tuple[dict[str, list[int]], ...]:
    """The shapes of the inputs and of the outputs, by name."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path))
    return tuple({one.name: one.shape for one in ends} for ends in (session.get_inputs(), session.get_outputs()))


@needs_onnx
def test_an_onnx_policy_acts_as_the_original_without_torch(onnx_file):
    import onnxruntime

    session = onnxruntime.InferenceSession(str(onnx_file))
    observations = random_observations(SAC, 50)
    expected = SAC.make_actor()(TensorDict(observations, batch_size=[50]))["loc"].detach().numpy()
    for row, loc in enumerate(expected):
        (action,) = session.run(None, {key: value[row : row + 1].numpy() for key, value in observations.items()})
        np.testing.assert_allclose(action[0], [1.0, np.pi] * np.tanh(loc), atol=1e-4)
    assert [entry.shape for entry in session.get_inputs()] == [[1, 32], [1, 3], [1, 2], [1, 2]]


def test_a_program_with_memory_acts_as_the_original_over_an_episode(tmp_path):
    checkpoint, path = recurrent_checkpoint(), tmp_path / "recurrent.pt2"
    assert export(checkpoint, path, "torch") <= exporting.TOLERANCE
    act, rows = torch.export.load(path).module(), TensorDict(random_observations(checkpoint, 3), [3]).split(1)
    runner, state = PolicyRunner(checkpoint.make_actor(), action_repeat=1), torch.zeros(1, 12)
    for row in rows:
        action, state = act(state, *row.values())
        torch.testing.assert_close(action, runner(row))
    forgetful, _ = act(torch.zeros(1, 12), *rows[-1].values())
    assert not torch.allclose(forgetful, action, atol=1e-3)


def test_a_policy_that_would_act_otherwise_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "TOLERANCE", -1.0)
    with pytest.raises(RuntimeError, match="acts otherwise"):
        export(SAC, tmp_path / "wrong.pt2", "torch")
    assert not [*tmp_path.iterdir()]


@needs_onnx
def test_what_is_no_policy_or_damaged_is_refused(onnx_file, tmp_path):
    path, data, draw = tmp_path / "foreign.onnx", onnx_file.read_bytes(), random.Random(0)
    for content in (b"", b"no onnx", data.replace(b"rover_rl_sha256", b"rover_rl_sha0000")):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"foreign\.onnx is damaged, or was not written by rover-rl export"):
            OnnxPolicy(path)
    for bit in draw.sample(range(8 * len(data)), 20):
        path.write_bytes(data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :])
        with pytest.raises(ValueError, match=r"foreign\.onnx is damaged"):
            OnnxPolicy(path)
    with pytest.raises(FileNotFoundError, match="no ONNX policy at"):
        OnnxPolicy(tmp_path / "missing.onnx")


@needs_onnx
def test_an_onnx_policy_does_not_act_on_what_is_not_finite(onnx_file):
    observations, policy = TensorDict(random_observations(SAC, 3), batch_size=[3]), OnnxPolicy(onnx_file)
    for number in (float("nan"), float("inf")):
        observations["imu"][2, 1] = number
        with pytest.raises(ValueError, match="observation 'imu' holds NaN or infinity: the policy does not act on it"):
            policy(observations)
    assert "action" not in observations


def test_missing_packages_are_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(ImportError, match=r"rover_rl\[onnx\]"):
        export(SAC, tmp_path / "moon.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"rover_rl\[onnx\]"):
        OnnxPolicy(tmp_path / "moon.onnx")


@needs_onnx
def test_a_policy_that_reads_the_route_takes_it_as_an_input_and_drives_as_the_original(tmp_path, monkeypatch, capsys):
    """It has been made for two robots, of which the file is for one."""
    monkeypatch.chdir(tmp_path)
    keys = ("lidar", "imu", "target", "velocities", "scan_pose", "robot", "route")
    network = {"observation": keys, "hidden": (16, 8)}
    config = training_config("ppo", world="maze", robot=("leo", "hunter"), sensors=("robot",), **network)
    torch.manual_seed(0)
    weights = actor_of(config).state_dict()
    [bias for name, bias in weights.items() if name.endswith("bias")][-1][0] += 1.0  # drives ahead
    Checkpoint(config=config, steps=100, actor=weights).save(tmp_path / "cars" / "checkpoint.pt")
    assert main(["export", "cars", "--robot", "hunter"]) == 0
    assert "The file reads route as input, which rover-rl drive cars.onnx computes" in capsys.readouterr().out
    sizes = {"lidar": 32, "imu": 3, "target": 2, "velocities": 2, "scan_pose": 6, "route": 5}
    assert shapes(tmp_path / "cars.onnx")[0] == {key: [1, size] for key, size in sizes.items()}
    original, policy = Checkpoint.load("cars").for_robot("hunter"), OnnxPolicy(Path("cars.onnx"))
    assert policy.made_for == original.env
    env = original.env.fitted()
    episodes = draw_episodes(env.world, 1, robot=env.robot)
    ours, theirs = (evaluate(each, episodes, env=env, seconds=2.0) for each in (original.make_actor(), policy))
    assert ours.action_repeat == theirs.action_repeat == 4
    assert_alike(ours.trajectories, theirs.trajectories)
    assert all((one.position[-1] - one.position[0]).norm() > 0.1 for one in ours.trajectories)


@pytest.mark.slow
@needs_onnx
def test_an_onnx_policy_with_memory_drives_as_the_original_and_commands_take_both(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    checkpoint, path = recurrent_checkpoint(), tmp_path / "mine.onnx"
    checkpoint.save(tmp_path / "mine" / "checkpoint.pt")
    assert main(["export", "mine"]) == 0
    state, sizes = [1, 12], {"lidar": [1, 32], "imu": [1, 3], "target": [1, 2], "velocities": [1, 2]}
    assert shapes(path) == ({"state_in": state, **sizes}, {"action": [1, 2], "state_out": state})
    policy, episodes = pickle.loads(pickle.dumps(OnnxPolicy(path))), stored_episodes("maze").first(3)
    # Fewer rows than episodes, whose memory is cleared when the next one begins.
    ours, theirs = (evaluate(each, episodes, seconds=1.0, rows=2) for each in (checkpoint.make_actor(), policy))
    assert ours.action_repeat == theirs.action_repeat == 4
    assert_alike(ours.trajectories, theirs.trajectories)
    options = ["--world", "maze", "--count", "1", "--seconds", "0.5", "--out", "."]
    assert main(["evaluate", "mine", "mine.onnx", *options]) == 0
    assert [entry["action_repeat"] for entry in json.loads(Path("evaluation.json").read_text())] == [4, 4]
