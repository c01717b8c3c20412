"""PPO of RLlib on a batch of rovers: ``pip install "ray[rllib]"``."""

from ray.rllib.algorithms.ppo import PPOConfig

import rover_rl

DECISIONS = 500_000  # of all rovers together, each of 4 steps
ROVERS = 256
BATCH = 32 * ROVERS

config = (
    PPOConfig()
    .environment(f"rover_rl:{rover_rl.LEARNING_ENV_ID}", env_config={"world_n": "inspect", "seed": 0})
    .env_runners(
        num_env_runners=0,
        num_envs_per_env_runner=ROVERS,
        gym_env_vectorize_mode="vector_entry_point",
        rollout_fragment_length=32,
    )
    .training(train_batch_size_per_learner=BATCH, minibatch_size=512, num_epochs=10, lr=3e-4, gamma=0.99)
    .debugging(seed=0)
)
algorithm = config.build_algo()
for _ in range(DECISIONS // BATCH):
    result = algorithm.train()
    print(result["num_env_steps_sampled_lifetime"], result["env_runners"].get("episode_return_mean"))
algorithm.save_to_path("runs/rllib")
algorithm.stop()
