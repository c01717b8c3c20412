"""Environments and policies do not depend on the defaults of PyTorch that a program sets, nor on inference mode."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import pytest
import torch

from rover_rl import Randomization, RewardConfig, make_env
from rover_rl.algos.policy.runner import PolicyRunner
from rover_rl.algos.pretrained import load_pretrained
from rover_rl.native.threads import kernel_threads, single_threaded

ACTION = torch.tensor([[0.5, 0.3], [0.7, -0.2]])
REWARD = RewardConfig(clearance_penalty=-0.1, action_rate_penalty=-0.01, risk_penalty=-0.1)
BACKENDS = {
    "bullet": {},
    "warp": {"randomization": Randomization.typical(), "sensors": ["route"], "world_n": "maze+walkers"},
}


@contextmanager
def inside(mode: str) -> Iterator[None]:
    """Lets a program be in a mode."""
    try:
        if mode == "float64":
            torch.set_default_dtype(torch.float64)
        elif mode == "device":
            torch.set_default_device("meta")
        with torch.inference_mode() if mode == "inference" else nullcontext():
            yield
    finally:
        torch.set_default_dtype(torch.float32)
        torch.set_default_device(None)


def drive(modes: list[str], backend: str) -> list[torch.Tensor]:
    """Makes and resets an environment in the first of the modes, takes a step in each, and returns what it gave."""
    with inside(modes[0]):
        settings = {"world_n": "maze", "num_envs": 2, "seed": 0, "reward": REWARD, **BACKENDS[backend]}
        env = make_env(backend=backend, **settings)
        now = env.reset()
    values = [now["lidar"], now["target"]]
    for mode in modes:
        with inside(mode):
            step = env.step(now.set("action", ACTION))
            now = env.step_mdp(step)
        values += [step["next", key] for key in ("pose", "imu", "lidar", "velocities", "reward")]
    return values


@pytest.mark.parametrize("backend", BACKENDS)
def test_an_environment_gives_the_same_numbers_in_all_modes_and_goes_on_in_others(backend):
    expected = drive([""] * 4, backend)
    modes = ("float64", "device", "inference")
    for sequence in (*([mode, "", mode, ""] for mode in modes), ["", *modes]):
        for value, right in zip(drive(sequence, backend), expected, strict=True):
            assert value.dtype == right.dtype
            assert torch.equal(value, right)


def test_a_policy_that_was_made_in_a_mode_drives_outside_of_it():
    checkpoint = load_pretrained("moon-ppo")
    env = make_env(world_n="maze", num_envs=2, seed=0, backend="warp", lidar=checkpoint.env.lidar)
    observation = env.reset()
    expected = PolicyRunner(checkpoint.make_actor())(observation)
    for mode in ("float64", "inference"):
        with inside(mode):
            actor = load_pretrained("moon-ppo").make_actor()
            runner = PolicyRunner(actor)
            assert torch.equal(runner(observation), expected)
        runner.reset()
        assert torch.equal(runner(observation), expected)
        actor(observation)["loc"].sum().backward()


@pytest.mark.parametrize("kind", [torch.float64, torch.float16, torch.int64])
def test_actions_of_other_types_and_with_gradients_are_taken(kind):
    env, action = make_env(world_n="maze", num_envs=2, seed=0, backend="warp"), torch.tensor([[1, 0], [0, 1]])
    given = action.to(kind).requires_grad_(kind.is_floating_point)
    results = []
    for each in (given, action.float()):
        env.set_seed(0)
        results.append(env.step(env.reset().set("action", each))["next"])
    assert torch.equal(results[0]["velocities"], results[1]["velocities"])
    assert not results[0]["reward"].requires_grad


def test_kernels_keep_the_threads_that_pytorch_gives_up():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        with single_threaded(), single_threaded():
            assert (torch.get_num_threads(), kernel_threads()) == (1, 3)
        assert (torch.get_num_threads(), kernel_threads()) == (3, 3)
    finally:
        torch.set_num_threads(before)
