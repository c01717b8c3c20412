"""
PPO in one script
=================

A policy learns to drive to goals with PPO in two minutes: the program of :doc:`TorchRL </torchrl>`, with its learning
curve. ``rover-rl train`` does the same with several processes, checkpoints, a decaying learning rate and mirror
augmentation.
"""

import matplotlib.pyplot as plt
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import Compose, RewardScaling, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from rover_rl import make_env
from rover_rl.envs.encoding import EncodedObservation
from rover_rl.envs.transforms.action_repeat import ActionRepeat

UPDATES = 48  # two minutes
ROVERS = 128
BATCH = 16 * ROVERS  # 16 actions of each rover
STEPS = 4 * BATCH  # simulator steps of 0.05 s in a batch: 4 per action

# %%
# Environment
# -----------
# Holding each action for 4 steps lets exploration have an effect. The scaled reward suits the usual settings of losses
# and gradient clipping. ``EncodedObservation`` adds ``observation``, one vector that is scaled for the task.

torch.manual_seed(0)
torch.set_num_threads(1)  # small networks do not gain from more
env = TransformedEnv(
    make_env(world_n="inspect", num_envs=ROVERS, backend="warp", seed=0),
    Compose(ActionRepeat(4), RewardScaling(loc=0.0, scale=0.05), EncodedObservation()),
)
size, spec = env.observation_spec["observation"].shape[-1], env.action_spec_unbatched
# %%
# Networks
# --------

actor = ProbabilisticActor(
    TensorDictModule(
        nn.Sequential(MLP(size, 4, num_cells=[128, 128], activation_class=nn.ReLU), NormalParamExtractor()),
        in_keys=["observation"],
        out_keys=["loc", "scale"],
    ),
    in_keys=["loc", "scale"],
    spec=spec,
    distribution_class=TanhNormal,
    distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
    return_log_prob=True,
)
critic = ValueOperator(MLP(size, 1, num_cells=[128, 128], activation_class=nn.ReLU), in_keys=["observation"])

# %%
# Collector, loss and optimizer
# -----------------------------

collector = Collector(
    env, actor, frames_per_batch=BATCH, total_frames=UPDATES * BATCH, auto_register_policy_transforms=False
)
buffer = ReplayBuffer(storage=LazyTensorStorage(BATCH), sampler=SamplerWithoutReplacement(), batch_size=512)
advantage = GAE(gamma=0.96, lmbda=0.95, value_network=critic, average_gae=True)
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.003)
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)

# %%
# Training
# --------
# The program prints the number of goals that a rover reaches per 2,000 steps, the length of a full episode. Random
# actions reach almost none, a good policy more than fifteen.

curve = []
for update, batch in enumerate(collector, 1):  # batches of shape [128, 16]
    advantage(batch)
    buffer.extend(batch.reshape(-1))
    for _ in range(10):
        for minibatch in buffer:
            losses = loss(minibatch)
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimizer.step()
    goals = batch["next", "outcome", "goals"].sum().item() * 2000 / STEPS
    print(f"{update * STEPS:9,} steps: {goals:5.2f} goals per 2,000 steps")
    curve.append((update * STEPS, goals))

# %%
# The learning curve:

figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
axes.plot(*zip(*curve, strict=True), marker=".")
axes.set(xlabel="steps of all rovers", ylabel="goals per 2,000 steps", ylim=(0, None))
axes.grid(alpha=0.3)
plt.show()
