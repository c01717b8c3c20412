"""
PPO in one script
=================

A policy learns to drive with PPO, in one script of TorchRL components, on a batch of rovers in the simulator Warp.
``rover-rl train`` does the same with several processes, checkpoints, a decaying learning rate and mirror augmentation.
"""

from __future__ import annotations

import matplotlib.pyplot as plt
import torch
from torchrl.collectors import Collector
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from rover_rl import make_env
from rover_rl.algos.policy.networks import make_actor, make_critic
from rover_rl.envs.transforms.action_repeat import ActionRepeat

STEPS = 100_000  # of all rovers together; 500_000 for a good policy
ROVERS = 64
ACTION_REPEAT = 4  # steps of 0.05 s per action: exploration noise at 20 Hz averages out
ROLLOUT_LENGTH = 16  # actions of each rover between two updates

# %%
# Environment and networks
# ------------------------
# The networks scale the observation for the task. Small networks do not gain from more threads.

torch.manual_seed(0)
torch.set_num_threads(1)
env = make_env(world_n="inspect", num_envs=ROVERS, length=600, seed=0, backend="warp")
env = env.append_transform(ActionRepeat(ACTION_REPEAT))
actor, critic = make_actor(), make_critic()

# %%
# Collector, loss and optimizer
# -----------------------------

batch_size = ROVERS * ROLLOUT_LENGTH
batches = max(1, STEPS // (batch_size * ACTION_REPEAT))
collector = Collector(
    env,
    actor,
    frames_per_batch=batch_size,
    total_frames=batches * batch_size,
    auto_register_policy_transforms=False,  # this policy needs none
)
advantage = GAE(gamma=0.96, lmbda=0.95, value_network=critic, average_gae=True)
loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.003, critic_coeff=0.5, loss_critic_type="l2")
optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)

# %%
# Training
# --------
# Each batch is a TensorDict ``[ROVERS, ROLLOUT_LENGTH]``. It prints the number of goals that a rover reaches per 2,000
# steps, the length of a full episode. Random actions reach almost none, a good policy more than fifteen.

steps, goals = [], []
for number, batch in enumerate(collector, 1):
    batch["next", "reward"] *= 0.05  # scales returns to the order of 1
    with torch.no_grad():
        advantage(batch)
    data = batch.reshape(-1)
    for _ in range(10):
        for minibatch in data[torch.randperm(batch_size)].split(256):
            losses = loss(minibatch)
            optimizer.zero_grad()
            (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimizer.step()
    steps.append(number * batch_size * ACTION_REPEAT)
    goals.append(batch["next", "outcome", "goals"].sum().item() * 2000 / (batch_size * ACTION_REPEAT))
    print(f"{steps[-1]:9,} steps: {goals[-1]:5.2f} goals per 2,000 steps")
collector.shutdown()

# %%
# The learning curve of these few steps:

figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
axes.plot(steps, goals, marker="o")
axes.set(xlabel="steps of all rovers", ylabel="goals per 2,000 steps", ylim=(0, None))
axes.grid(alpha=0.3)
plt.show()
