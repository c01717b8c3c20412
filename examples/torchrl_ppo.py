"""PPO on a batch of rovers, with TorchRL's own parts on one page.

    python examples/torchrl_ppo.py    # half a million steps: some minutes

Every few seconds it prints how many goals the rovers reach in 2,000 steps, the length of a full episode. Random actions
reach next to none, and a good policy more than ten. `rover-rl train` does the same in several processes, with
checkpoints, a learning rate that falls, and mirror images of what was driven.
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

REPEAT = 4  # steps of 0.05 s that an action is held for: noise at 20 Hz averages out, and explores nothing
DECISIONS = 16  # of each rover between two updates


def main(steps: int = 500_000, world: str = "moon", rovers: int = 64) -> None:
    """Trains a policy with PPO.

    Args:
        steps: to train for, all rovers together.
        world: to drive in.
        rovers: that drive at once.
    """
    torch.manual_seed(0)
    torch.set_num_threads(1)  # networks this small gain nothing from more
    env = make_env(world_n=world, num_envs=rovers, length=600, seed=0).append_transform(ActionRepeat(REPEAT))
    actor, critic = make_actor(), make_critic()
    batch_size = rovers * DECISIONS
    batches = max(1, steps // (batch_size * REPEAT))
    collector = Collector(
        env,
        actor,
        frames_per_batch=batch_size,
        total_frames=batches * batch_size,
        auto_register_policy_transforms=False,  # of which this policy needs none
    )
    advantage = GAE(gamma=0.96, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(actor, critic, clip_epsilon=0.2, entropy_coeff=0.01, critic_coeff=0.5, loss_critic_type="l2")
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-4)

    for number, batch in enumerate(collector, 1):  # a TensorDict [rovers, DECISIONS]
        batch["next", "reward"] *= 0.05  # values of about 1 are learned best
        with torch.no_grad():
            advantage(batch)
        decisions = batch.reshape(-1)
        for _ in range(10):
            for minibatch in decisions[torch.randperm(batch_size)].split(256):
                losses = loss(minibatch)
                optimizer.zero_grad()
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
        goals = batch["next", "outcome", "goals"].sum().item() * 2000 / (batch_size * REPEAT)
        print(f"{number * batch_size * REPEAT:9,} steps: {goals:5.2f} goals in 2,000 steps")
    collector.shutdown()


if __name__ == "__main__":
    tyro.cli(main)
