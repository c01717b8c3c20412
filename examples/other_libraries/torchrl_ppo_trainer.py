"""PPOTrainer of TorchRL on a batch of rovers. TorchRL is installed with this package."""

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import RewardScaling
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.trainers.algorithms import PPOTrainer

from rover_rl import make_env
from rover_rl.envs.encoding import EncodedObservation
from rover_rl.envs.transforms.action_repeat import ActionRepeat

DECISIONS = 500_000  # of all rovers together, each of 4 steps
ROVERS = 256
BATCH, MINIBATCH = 32 * ROVERS, 512

torch.set_num_threads(1)  # small networks do not gain from more threads
torch.manual_seed(0)
env = make_env(world_n="inspect", num_envs=ROVERS, seed=0, backend="warp")
for transform in (ActionRepeat(4), RewardScaling(loc=0.0, scale=0.05), EncodedObservation()):
    env = env.append_transform(transform)
spec = env.action_spec_unbatched
size = env.observation_spec["observation"].shape[-1]
network = nn.Sequential(MLP(size, 2, num_cells=[128, 128]), AddStateIndependentNormalScale(2))
actor = ProbabilisticActor(
    TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
    in_keys=["loc", "scale"],
    spec=spec,
    distribution_class=TanhNormal,
    distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
    return_log_prob=True,
)
critic = ValueOperator(MLP(size, 1, num_cells=[128, 128]), in_keys=["observation"])
loss = ClipPPOLoss(actor, critic, entropy_coeff=0.003)
trainer = PPOTrainer(
    collector=Collector(env, actor, frames_per_batch=BATCH, total_frames=DECISIONS),
    total_frames=DECISIONS,
    frame_skip=1,
    optim_steps_per_batch=None,  # as many as the batch has minibatches
    num_epochs=10,
    loss_module=loss,
    optimizer=torch.optim.Adam(loss.parameters(), lr=3e-4),
    replay_buffer=ReplayBuffer(
        storage=LazyTensorStorage(BATCH), sampler=SamplerWithoutReplacement(), batch_size=MINIBATCH
    ),
    gamma=0.99,
    enable_logging=False,
    seed=0,
)
trainer.train()
