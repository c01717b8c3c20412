"""Training with PPO on a batch of rovers, in one script of TorchRL components.

    python examples/torchrl_ppo.py    # 500,000 steps: a few minutes

After each batch it prints the number of goals that a rover reaches per 2,000 steps, the length of a full episode.
Random actions reach almost none, a good policy more than ten. `rover-rl train` adds several processes, checkpoints, a
decaying learning rate and mirror augmentation.
"""

from __future__ import annotations

import torch
import tyro
from torchrl.collectors import Collector
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from rover_rl import make_env
from rover_rl.algos.policy.networks import make_actor, make_critic
from rover_rl.envs.transforms.action_repeat import ActionRepeat

ACTION_REPEAT = 4  # steps of 0.05 s per action: exploration noise at 20 Hz averages out
ROLLOUT_LENGTH = 16  # actions of each rover between two updates


def main(steps: int = 500_000, world: str = "moon", rovers: int = 64) -> None:
    """Trains a policy with PPO.

    Args:
        steps: total number of environment steps of all rovers.
        world: name of the world.
        rovers: number of rovers in the batch.
    """
    torch.manual_seed(0)
    torch.set_num_threads(1)  # small networks do not gain from more threads
    env = make_env(world_n=world, num_envs=rovers, length=600, seed=0).append_transform(ActionRepeat(ACTION_REPEAT))
    actor, critic = make_actor(), make_critic()
    batch_size = rovers * ROLLOUT_LENGTH
    batches = max(1, steps // (batch_size * ACTION_REPEAT))
    collector = Collector(
        env,
        actor,
        frames_per_batch=batch_size,
        total_frames=batches * batch_size,
        auto_register_policy_transforms=False,  # this policy needs none
    )
    advantage = GAE(gamma=0.96, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.01, critic_coeff=0.5, loss_critic_type="l2")
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)

    for number, batch in enumerate(collector, 1):  # a TensorDict [rovers, ROLLOUT_LENGTH]
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
        goals = batch["next", "outcome", "goals"].sum().item() * 2000 / (batch_size * ACTION_REPEAT)
        print(f"{number * batch_size * ACTION_REPEAT:9,} steps: {goals:5.2f} goals per 2,000 steps")
    collector.shutdown()


if __name__ == "__main__":
    tyro.cli(main)
