"""Exported policies that read the route: their files hold the map, the planner and the network."""

from __future__ import annotations

import pickle
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.export import ExportedProgram
from torchrl.envs.utils import ExplorationType, set_exploration_type

from rover_rl.algos.config import training_config
from rover_rl.algos.deploy import comparison
from rover_rl.algos.deploy.comparison import drive_observations
from rover_rl.algos.deploy.export import TOLERANCE, OnnxPolicy, export, onnx_function, program_function
from rover_rl.algos.deploy.plain_policy import PlainPolicy, robot_numbers
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.algos.policy.checkpoint import Checkpoint
from rover_rl.algos.policy.networks import actor_of
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.cli import main
from rover_rl.envs.config import SCAN_POSE
from rover_rl.envs.seen_map.scans import UNSEEN
from rover_rl.envs.seen_map.seen_map import BOUNDS
from rover_rl.envs.sensors.scan_pose import scan_pose_now
from tests.algos.deploy.onnx_files import needs_onnx, shapes
from tests.algos.evaluation.drives import assert_alike

pytestmark = [needs_onnx, pytest.mark.slow]
MAP = 2 + 1 + 2 + 1 + 2 + 2 * 128 * 128
"""Entries of the state of a map: the middle of the window, whether the ground is rough, the place around which the
rover is, its number of scans there, the first corner of its route, and the cells of the window and their heights."""
SIZES = {"lidar": 32, "imu": 3, "target": 2, "velocities": 2, "scan_pose": 6, "pose": 3, "bounds": 4}
"""Inputs of the policy without memory, and their sizes."""
UNITS = 12
DECISIONS = 30


def routed_checkpoint(memory: str) -> Checkpoint:
    """A checkpoint of a small network with random weights that reads the route.

    Without memory, it adds to a driver, reads where scans were taken, and has been made for two robots, of which it
    drives a car.
    """
    keys, prior, robot = ("lidar", "target", "route"), "none", {}
    if memory == "none":
        keys, prior = ("lidar", "imu", "target", "velocities", "scan_pose", "robot", "route"), "route"
        robot = {"robot": ("leo", "hunter"), "sensors": ("robot",)}
    network = {"observation": keys, "hidden": (16, 8), "memory": memory, "memory_size": UNITS, "prior": prior}
    config = training_config("ppo", world="maze", **robot, **network)
    torch.manual_seed(0)
    actor = actor_of(config)
    # Enlarged, so that its actions differ, and with a preference for driving ahead.
    weights = {name: weight * 2.0 for name, weight in actor.state_dict().items()}
    (last,) = (name for name, weight in weights.items() if weight.shape == (4,))
    weights[last] = torch.tensor([0.8, 0.0, 0.0, 0.0])
    checkpoint = Checkpoint(config=config, steps=100, actor=weights)
    return checkpoint.for_robot("hunter") if robot else checkpoint


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Holds the policy without memory: exported to ONNX by the command, and to a program."""
    folder, checkpoint, trace = tmp_path_factory.mktemp("routed"), routed_checkpoint("none"), torch.export.export
    checkpoint.save(folder / "car" / "checkpoint.pt")
    traced: list[ExportedProgram] = []

    def traced_once(*given: Any) -> ExportedProgram:
        traced.extend([] if traced else [trace(*given)])
        return traced[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(comparison, "CHECKED_DRIVE", DECISIONS)
        # Both formats begin with the same program, which takes ten seconds.
        patch.setattr(torch.export, "export", traced_once)
        assert export(checkpoint, folder / "car.pt2", "torch") <= TOLERANCE
        # Optimizing the graph of a map takes a minute. Those of test_export are optimized.
        patch.setattr(torch.onnx, "export", partial(torch.onnx.export, optimize=False))
        assert main(["export", str(folder / "car"), "--out", str(folder / "car.onnx")]) == 0
    return folder


@pytest.fixture(scope="module")
def policy(folder: Path) -> OnnxPolicy:
    """The policy from the ONNX file, which takes seconds to open. It keeps its state in the observations."""
    return OnnxPolicy(folder / "car.onnx")


def drive(memory: str) -> list[TensorDict]:
    """The observations of a drive, as a batch of one row each."""
    checkpoint = routed_checkpoint(memory)
    observations = TensorDict(drive_observations(checkpoint, DECISIONS), [DECISIONS])
    if memory == "none":
        observations["robot"] = robot_numbers(checkpoint).expand(DECISIONS, -1)
    return list(observations.split(1))


def actions_of(policy, observations: list[TensorDict]) -> Tensor:
    """The actions in an episode."""
    runner = PolicyRunner(policy, action_repeat=1)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return torch.cat([runner(observation) for observation in observations])


def assert_same(actions: Tensor, expected: Tensor) -> None:
    """Checks that 99 % of the actions are equal, and that they differ from one another."""
    assert ((actions - expected).abs().amax(-1) <= 1e-4).float().mean() >= 0.99
    assert (expected.std(0) > 0.003).all()


def test_the_file_reads_what_the_network_and_the_map_read(folder, policy):
    sizes = {key: [1, size] for key, size in SIZES.items()}
    expected = ({"state_in": [1, MAP], **sizes}, {"action": [1, 2], "state_out": [1, MAP]})
    assert shapes(folder / "car.onnx") == expected
    assert policy.in_keys == [*sizes, "memory", "is_init"]


def test_an_exported_policy_acts_as_the_original_over_an_episode(policy):
    observations = drive("none")
    expected = actions_of(routed_checkpoint("none").make_actor(), observations)
    assert_same(actions_of(pickle.loads(pickle.dumps(policy)), observations), expected)


def test_a_program_acts_as_the_original_over_an_episode(folder):
    observations, act, state = drive("none")[:10], program_function(folder / "car.pt2"), torch.zeros(1, MAP)
    actions = []
    for observation in observations:
        action, state = act({**observation.exclude("robot"), "state_in": state})
        actions.append(action)
    assert_same(torch.cat(actions), actions_of(routed_checkpoint("none").make_actor(), observations))
    observations[0][BOUNDS][0, 2] = torch.inf
    with pytest.raises(ValueError, match="observation 'bounds' holds NaN or infinity"):
        act({**observations[0], "state_in": state})


def test_a_memory_follows_the_map_in_the_state():
    checkpoint, observations = routed_checkpoint("gru"), drive("gru")[:10]
    policy, state, actions = PlainPolicy(checkpoint).eval(), torch.zeros(1, MAP + UNITS), []
    with torch.no_grad():
        for observation in observations:
            action, state = policy(*(observation.get(key, state) for key in policy.inputs))
            actions.append(action)
    assert_same(torch.cat(actions), actions_of(checkpoint.make_actor(), observations))
    assert state.shape == (1, policy.state_size) == (1, MAP + UNITS)
    assert (state[:, MAP:] != 0).all()


def test_the_state_holds_the_map_and_is_cleared_row_by_row(folder, policy):
    observations = drive("none")[:6]
    # A scan that is not late.
    observations[0][SCAN_POSE] = scan_pose_now(observations[0]["imu"])
    runner = PolicyRunner(policy, action_repeat=1)
    for observation in observations:
        action = runner(torch.cat([observation, observation]))
    assert torch.equal(action[0], action[1])
    runner.reset(torch.tensor([False, True]))
    after = runner(torch.cat([observations[0], observations[0]]))
    assert torch.equal(after[1:], PolicyRunner(policy)(observations[0]))
    assert not torch.allclose(after[0], after[1], atol=1e-3)
    _, state = onnx_function(folder / "car.onnx")({**observations[0], "state_in": torch.zeros(1, MAP)})
    center, rough, place, scans, corner, cells, heights = state.split((2, 1, 2, 1, 2, 128 * 128, 128 * 128), -1)
    assert torch.equal(center, (observations[0]["pose"][:, :2] / 0.15).floor())
    assert rough == 0
    assert torch.equal(place, observations[0]["pose"][:, :2])
    assert scans == 1
    assert (corner - place).norm() >= 0.5
    assert 10 < cells.count_nonzero() < 1000
    assert (heights == UNSEEN).all(), "the ground is not rough"


def test_routes_stay_in_the_bounds(policy):
    observation = drive("none")[0].exclude(BOUNDS)
    # The goal is outside.
    bounds = observation["pose"][:, [0, 1, 0, 1]] + torch.tensor([-1.0, -1.0, 1.0, 1.0])
    both = (policy, routed_checkpoint("none").make_actor())
    seen = (observation, observation.clone().set(BOUNDS, bounds))
    without, within = (torch.cat([actions_of(each, [one]) for each in both]) for one in seen)
    for ours, theirs in (without, within):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=0)
    assert (without[0] - within[0]).abs().max() > 1e-3


def test_it_drives_as_the_original_in_a_maze(policy):
    env = routed_checkpoint("none").env.fitted()
    episodes = draw_episodes(env.world, 3, robot=env.robot)
    drivers = (routed_checkpoint("none").make_actor(), policy)
    # Fewer rows than episodes, whose map is cleared when the next one begins.
    ours, theirs = (evaluate(driver, episodes, env=env, seconds=2.0, rows=2) for driver in drivers)
    assert ours.action_repeat == theirs.action_repeat == 4
    assert ours.endings == theirs.endings
    assert_alike(ours.trajectories, theirs.trajectories)
    assert all((one.position[-1] - one.position[0]).norm() > 0.1 for one in ours.trajectories)
