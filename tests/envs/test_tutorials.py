"""TorchRL's tutorials, run with this environment."""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import (
    LazyTensorStorage,
    ReplayBuffer,
    SamplerWithoutReplacement,
)
from torchrl.envs import (
    CatTensors,
    Compose,
    DoubleToFloat,
    ObservationNorm,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from rover_rl import RoverEnv, make_env

BATCHES = pytest.mark.parametrize(
    ("num_envs", "backend", "device"),
    [(None, "bullet", "cpu"), (4, "bullet", None), (4, "warp", "cpu")],
)
CELLS = 16

pytestmark = [
    # Warnings of TorchRL about its own defaults.
    pytest.mark.filterwarnings("ignore:The env passed to Collector is missing transforms:FutureWarning"),
    pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size:UserWarning"),
]


@BATCHES
def test_the_ppo_tutorial(num_envs, backend, device):
    """The tutorial "Reinforcement learning (PPO) with TorchRL", shortened."""
    frames_per_batch, total_frames, sub_batch_size = 64, 192, 32
    torch.manual_seed(0)
    base_env = make_env(world_n="maze", num_envs=num_envs, backend=backend, device=device, seed=0)
    env = TransformedEnv(
        base_env,
        Compose(
            ObservationNorm(in_keys=["lidar"]),
            CatTensors(["lidar", "target"], "observation", del_keys=False),
            DoubleToFloat(),
            StepCounter(),
        ),
    )
    # A batch has time as its second dimension, and the statistics also average over its rows.
    dims = {"reduce_dim": 0, "cat_dim": 0} if num_envs is None else {"reduce_dim": (0, 1), "cat_dim": 1}
    env.transform[0].init_stats(num_iter=30, **dims)
    assert env.transform[0].loc.shape == (32,)
    check_env_specs(env)
    assert env.rollout(3).shape == (*env.batch_size, 3)

    action_spec = env.action_spec_unbatched
    actor_net = nn.Sequential(
        nn.LazyLinear(CELLS, device=device),
        nn.Tanh(),
        nn.LazyLinear(2 * env.action_spec.shape[-1], device=device),
        NormalParamExtractor(),
    )
    policy_module = ProbabilisticActor(
        module=TensorDictModule(actor_net, in_keys=["observation"], out_keys=["loc", "scale"]),
        spec=action_spec,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": action_spec.space.low, "high": action_spec.space.high},
        return_log_prob=True,
    )
    value_net = nn.Sequential(nn.LazyLinear(CELLS, device=device), nn.Tanh(), nn.LazyLinear(1, device=device))
    value_module = ValueOperator(module=value_net, in_keys=["observation"])
    assert policy_module(env.reset())["action"].shape == (*env.batch_size, 2)
    assert value_module(env.reset())["state_value"].shape == (*env.batch_size, 1)
    before = [weight.detach().clone() for weight in policy_module.parameters()]

    collector = Collector(
        env,
        policy_module,
        frames_per_batch=frames_per_batch,
        total_frames=total_frames,
        split_trajs=False,
        device=device,
    )
    replay_buffer = ReplayBuffer(
        storage=LazyTensorStorage(max_size=frames_per_batch), sampler=SamplerWithoutReplacement()
    )
    advantage_module = GAE(gamma=0.99, lmbda=0.95, value_network=value_module, average_gae=True, device=device)
    loss_module = ClipPPOLoss(
        actor_network=policy_module,
        critic_network=value_module,
        clip_epsilon=0.2,
        entropy_bonus=True,
        entropy_coeff=1e-4,
        critic_coeff=1.0,
        loss_critic_type="smooth_l1",
    )
    optim = torch.optim.Adam(loss_module.parameters(), 3e-4)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optim, total_frames // frames_per_batch, 0.0)

    rewards, evaluated = [], []
    for tensordict_data in collector:
        for _ in range(2):
            advantage_module(tensordict_data)
            replay_buffer.extend(tensordict_data.reshape(-1).cpu())
            for _ in range(frames_per_batch // sub_batch_size):
                subdata = replay_buffer.sample(sub_batch_size)
                loss_vals = loss_module(subdata if device is None else subdata.to(device))
                loss_value = loss_vals["loss_objective"] + loss_vals["loss_critic"] + loss_vals["loss_entropy"]
                loss_value.backward()
                assert torch.isfinite(loss_value)
                torch.nn.utils.clip_grad_norm_(loss_module.parameters(), 1.0)
                optim.step()
                optim.zero_grad()
        assert tensordict_data.numel() == frames_per_batch
        rewards.append(tensordict_data["next", "reward"].mean().item())
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            eval_rollout = env.rollout(10, policy_module)
            evaluated.append((eval_rollout["next", "reward"].sum().item(), eval_rollout["step_count"].max().item()))
        scheduler.step()
    assert len(rewards) == len(evaluated) == 3
    assert [steps for _, steps in evaluated] == [9, 9, 9]
    assert all(not torch.equal(old, new) for old, new in zip(before, policy_module.parameters(), strict=True))
    assert env.rollout(5, policy_module).shape == (*env.batch_size, 5)


@pytest.mark.parametrize("num_envs", [None, 3])
@pytest.mark.parametrize("make", [make_env, RoverEnv])
def test_rollouts_within_and_after_a_collectors_loop(make, num_envs):
    """The collector closes its environment before it hands out the last batch."""
    env = make(world_n="maze", num_envs=num_envs, length=7, seed=0)
    frames = 6 * env.numel()
    batches = 0
    for batch in Collector(env, env.rand_action, frames_per_batch=frames, total_frames=4 * frames):
        assert batch.shape == (*env.batch_size, 6)
        assert env.rollout(9, break_when_any_done=False).shape == (*env.batch_size, 9)
        assert env.rollout(9, break_when_all_done=True).shape == (*env.batch_size, 7)
        batches += 1
    assert batches == 4
    assert env.rollout(9).shape == (*env.batch_size, 7)
