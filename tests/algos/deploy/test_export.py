from __future__ import annotations

import io
import json
import pickle
import random
import sys
from contextlib import redirect_stdout
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from rover_rl import Randomization, RewardConfig, TaskConfig
from rover_rl.algos.config import training_config
from rover_rl.algos.deploy import comparison
from rover_rl.algos.deploy import export as exporting
from rover_rl.algos.deploy.comparison import random_observations
from rover_rl.algos.deploy.export import OnnxPolicy, export, onnx_function, program_function
from rover_rl.algos.evaluation.episodes import stored_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import ObservationEncoder, actor_of, make_actor
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.cli import main
from rover_rl.envs.config import ActionConfig
from tests.algos.deploy.onnx_files import needs_onnx, shapes
from tests.algos.evaluation.drives import assert_alike
from tests.algos.policy.memories import recurrent_checkpoint

POLICY, SAC = load_pretrained("moon-ppo"), load_pretrained("moon-sac")


@pytest.fixture(scope="module")
def onnx_file(tmp_path_factory) -> Path:
    """What the command writes of SAC's policy."""
    folder, told = tmp_path_factory.mktemp("onnx"), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(told):
        patch.chdir(folder)
        assert main(["export", "pretrained:moon-sac"]) == 0
    assert "moon-sac.onnx: acts as pretrained:moon-sac does" in told.getvalue()
    return folder / "moon-sac.onnx"


@pytest.fixture(scope="module")
def program_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("program") / "moon.pt2"
    assert export(POLICY, path, "torch") <= exporting.TOLERANCE
    return path


@pytest.fixture
def few_checks(monkeypatch) -> None:
    """Exported policies are compared on 100 observations: the files of the module are compared on all."""
    monkeypatch.setattr(comparison, "CHECKED", 100)


def expected(checkpoint: Checkpoint, observations: dict[str, torch.Tensor]) -> torch.Tensor:
    return checkpoint.make_actor()(TensorDict(observations, batch_size=[len(observations["lidar"])]))["loc"]


@needs_onnx
def test_an_onnx_policy_acts_as_the_original_without_torch(onnx_file):
    import onnxruntime

    session = onnxruntime.InferenceSession(str(onnx_file))
    observations = random_observations(SAC, 50)
    low, high = np.array([-1.0, -np.pi]), np.array([1.0, np.pi])
    for row, loc in enumerate(expected(SAC, observations).detach().numpy()):
        (action,) = session.run(None, {key: value[row : row + 1].numpy() for key, value in observations.items()})
        np.testing.assert_allclose(action[0], (low + high) / 2 + (high - low) / 2 * np.tanh(loc), atol=1e-4)
    assert [entry.shape for entry in session.get_inputs()] == [[1, 32], [1, 3], [1, 2], [1, 2]]


def test_a_program_acts_as_the_original(program_file):
    act = program_function(program_file)
    observation = random_observations(POLICY, 1)
    loc = expected(POLICY, observation)
    torch.testing.assert_close(act(observation), torch.tensor([[1.0, torch.pi]]) * torch.tanh(loc))
    observation["target"][0, 0] = torch.nan
    with pytest.raises(ValueError, match="observation 'target' holds NaN or infinity"):
        act(observation)


def test_a_damaged_program_is_refused(program_file, tmp_path):
    data, path = program_file.read_bytes(), tmp_path / "moon.pt2"
    for damaged in (b"", b"no program", data[: len(data) // 2], flipped(data, 8 * 5000)):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"moon\.pt2 is damaged, or was not written by rover-rl export"):
            program_function(path)


@pytest.mark.usefixtures("few_checks")
def test_a_policy_that_would_act_otherwise_is_not_written(tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "TOLERANCE", -1.0)
    with pytest.raises(RuntimeError, match="acts otherwise"):
        export(POLICY, tmp_path / "wrong.pt2", "torch")
    assert not [*tmp_path.iterdir()]


@needs_onnx
def test_what_is_no_policy_is_refused(onnx_file, tmp_path):
    path, data = tmp_path / "foreign.onnx", onnx_file.read_bytes()
    for content in (b"", b"no onnx", b"\x08\x08", data.replace(b"rover_rl_sha256", b"rover_rl_sha0000")):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"foreign\.onnx is damaged, or was not written by rover-rl export"):
            OnnxPolicy(path)
    with pytest.raises(FileNotFoundError, match="no ONNX policy at"):
        OnnxPolicy(tmp_path / "missing.onnx")


@needs_onnx
def test_a_flipped_bit_of_an_onnx_policy_is_refused_or_changes_nothing(onnx_file, tmp_path):
    data, path, draw = onnx_file.read_bytes(), tmp_path / "flipped.onnx", random.Random(0)
    observation = random_observations(SAC, 1)
    expected = onnx_function(onnx_file)(observation)
    # Half of them in the settings and the checksum at the end.
    bits = draw.sample(range(8 * len(data)), 60) + draw.sample(range(8 * (len(data) - 1000), 8 * len(data)), 60)
    refused = 0
    for bit in bits:
        path.write_bytes(flipped(data, bit))
        try:
            policy = OnnxPolicy(path)
        except ValueError as error:
            assert "flipped.onnx" in str(error)  # noqa: PT017
            refused += 1
        else:
            assert policy.config == SAC.config
            assert torch.equal(onnx_function(path)(observation), expected)
    assert refused > 60


def flipped(data: bytes, bit: int) -> bytes:
    return data[: bit // 8] + bytes([data[bit // 8] ^ 1 << bit % 8]) + data[bit // 8 + 1 :]


@needs_onnx
def test_an_onnx_policy_does_not_act_on_what_is_not_finite(onnx_file):
    observations, policy = TensorDict(random_observations(SAC, 3), batch_size=[3]), OnnxPolicy(onnx_file)
    for number in (float("nan"), float("inf")):
        observations["imu"][2, 1] = number
        with pytest.raises(ValueError, match="observation 'imu' holds NaN or infinity: the policy does not act on it"):
            policy(observations)
    assert "action" not in observations


@needs_onnx
@pytest.mark.parametrize(
    ("entry", "settings", "message"),
    [
        ("movers", {}, "a policy that reads movers cannot be exported"),
        ("route", {"randomization": Randomization(dead_sectors=1)}, "can be exported only if it reads lidar_mask"),
    ],
)
def test_a_policy_whose_map_lacks_what_it_read_is_refused(tmp_path, entry, settings, message):
    config = training_config("ppo", hidden=(8,), observation=("lidar", "target", entry), **settings)
    checkpoint = Checkpoint(config=config, steps=0, actor=actor_of(config).state_dict())
    with pytest.raises(ValueError, match=message):
        export(checkpoint, tmp_path / "movers.onnx")


@pytest.mark.slow
@needs_onnx
@pytest.mark.usefixtures("few_checks")
def test_a_policy_that_turns_to_the_north_and_drives_forward_only_drives_as_the_original_in_its_task(tmp_path):
    network = {"hidden": (16,), "north_up": True, "mirror_augmentation": False}
    task, reward = TaskConfig(collision_from="contact", collision_window=0), RewardConfig(clearance_penalty=-0.1)
    made_for = {"action": ActionConfig(min_speed=0.0), "task": task, "contract_reward": reward}
    config = training_config("ppo", world="maze", max_std=0.4, **made_for, **network)
    torch.manual_seed(0)
    encoder = ObservationEncoder(north_up=True)
    actor = make_actor(encoder, (16,), config.env.action, max_std=0.4)
    weights = {name: 2 * weight for name, weight in actor.state_dict().items()}
    checkpoint, path = Checkpoint(config=config, steps=100, actor=weights), tmp_path / "north.onnx"
    assert export(checkpoint, path) <= exporting.TOLERANCE
    policy, episodes = OnnxPolicy(path), stored_episodes("maze").first(2)
    assert policy.made_for == config.env
    assert (policy.made_for.action.min_speed, policy.made_for.task) == (0.0, task)
    ours, theirs = (evaluate(each, episodes, seconds=2.0) for each in (checkpoint.make_actor(), policy))
    assert_alike(ours.trajectories, theirs.trajectories)


def test_missing_packages_are_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(ImportError, match=r"rover_rl\[onnx\]"):
        export(replace(POLICY, config=training_config("ppo")), tmp_path / "moon.onnx")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"rover_rl\[onnx\]"):
        onnx_function(tmp_path / "moon.onnx")


@pytest.mark.slow
@pytest.mark.usefixtures("few_checks")
def test_a_program_with_memory_acts_as_the_original_over_an_episode(tmp_path):
    checkpoint, path = recurrent_checkpoint("gru"), tmp_path / "recurrent.pt2"
    # The difference is the largest one in an episode of 100 decisions.
    assert export(checkpoint, path, "torch") <= exporting.TOLERANCE
    act, rows = program_function(path), TensorDict(random_observations(checkpoint, 3), batch_size=[3]).split(1)
    runner, state = PolicyRunner(checkpoint.make_actor(), action_repeat=1), torch.zeros(1, 12)
    for row in rows:
        action, state = act({**row, "state_in": state})
        torch.testing.assert_close(action, runner(row))
    forgetful, _ = act({**rows[-1], "state_in": torch.zeros(1, 12)})
    assert not torch.allclose(forgetful, action, atol=1e-3)
    state[0, 3] = torch.nan
    with pytest.raises(ValueError, match="observation 'state_in' holds NaN or infinity"):
        act({**rows[0], "state_in": state})


@pytest.mark.slow
@needs_onnx
@pytest.mark.usefixtures("few_checks")
def test_an_onnx_policy_with_memory_drives_as_the_original_and_commands_take_both(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    checkpoint, path = recurrent_checkpoint("lstm"), tmp_path / "mine.onnx"
    checkpoint.save(tmp_path / "mine" / "checkpoint.pt")
    assert main(["export", "mine"]) == 0
    state, sizes = [1, 24], {"lidar": [1, 32], "imu": [1, 3], "target": [1, 2], "velocities": [1, 2]}
    assert shapes(path) == ({"state_in": state, **sizes}, {"action": [1, 2], "state_out": state})
    policy, episodes = pickle.loads(pickle.dumps(OnnxPolicy(path))), stored_episodes("maze").first(3)
    # Fewer rows than episodes, whose memory is cleared when the next one begins.
    ours, theirs = (evaluate(each, episodes, seconds=2.0, rows=2) for each in (checkpoint.make_actor(), policy))
    assert ours.action_repeat == theirs.action_repeat == 4
    assert_alike(ours.trajectories, theirs.trajectories)
    for policies, repeats in (("mine mine.onnx", [4, 4]), ("mine --action-repeat 2", [2])):
        options = "--world maze --count 2 --seconds 0.5 --out ."
        assert main(["evaluate", *policies.split(), *options.split()]) == 0
        assert [entry["action_repeat"] for entry in json.loads(Path("evaluation.json").read_text())] == repeats
