"""Training environment, in which one step is one decision of the policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from torch import Tensor
from torchrl.envs import EnvBase, RewardSum, StepCounter, Transform

from rover_rl.algos.config import TrainingConfig
from rover_rl.algos.policy.recurrent import memory_transforms
from rover_rl.algos.train.attempts import AttemptCounter, SpreadEnds
from rover_rl.algos.train.curriculum import Curriculum
from rover_rl.algos.train.live import LiveRovers
from rover_rl.algos.workers import usable_cores
from rover_rl.envs.actions import find_action
from rover_rl.envs.config import DEFAULT_PHYSICS, EnvConfig, SensorLike
from rover_rl.envs.make import add_terms, check_terms
from rover_rl.envs.rover import RoverEnv
from rover_rl.envs.sensors.cameras import PixelImage
from rover_rl.envs.sensors.suite import own_sensors, with_sensors
from rover_rl.envs.transforms.action_repeat import ActionRepeat
from rover_rl.envs.transforms.path_reward import PathReward, RevisitPenalty, RouteReward
from rover_rl.envs.transforms.step_clock import StepClock
from rover_rl.robots import get_robots
from rover_rl.sims.backends import find_settings
from rover_rl.worlds.pool import WorldPool

SESSION_SEEDS = 1_000_003
"""Offset of the seeds of each session of a run, so that a resumed run draws new starts and goals."""


def make_training_env(
    config: TrainingConfig,
    worker: int = 0,
    session: int = 0,
    estimates: Mapping[str, Tensor] | None = None,
    per_batch: bool = False,
    watched: Path | None = None,
) -> EnvBase:
    """Makes the environment of one worker, in which one step is one decision of the policy.

    The first episode of each row has a random length, so that the resets of the rows are spread over time.
    Those who watch the run in the folder ``watched`` see rovers of the first worker.
    """
    env_config = _worker_env_config(config, worker, session)
    check_terms(env_config)
    rovers, settings = RoverEnv(env_config), config.collection
    ends = SpreadEnds(-(-env_config.length // settings.action_repeat))
    transforms: list[Transform] = [ActionRepeat(settings.action_repeat)]
    if settings.route_reward:
        transforms.append(RouteReward(settings.route_reward))
    if settings.path_reward:
        transforms.append(PathReward(rovers, settings.path_reward))
    if settings.revisit_penalty:
        transforms.append(RevisitPenalty(settings.revisit_penalty, settings.action_repeat * rovers.control_dt))
    if settings.curriculum != "none":
        share, temperature = settings.curriculum_share, settings.curriculum_temperature
        transforms.append(Curriculum(rovers, share, temperature, estimates, per_batch))
    transforms += [RewardSum(["reward"], ["episode_reward"]), StepCounter(), ends]
    transforms.append(AttemptCounter(ends, settings.action_repeat, env_config.length, rovers.control_dt))
    transforms += memory_transforms(config.network.memory, config.network.memory_size)
    if watched is not None and not worker:
        transforms.append(LiveRovers(rovers, watched))
    env = add_terms(rovers, env_config)
    for transform in (*transforms, StepClock(rovers, worker, per_batch)):
        env = env.append_transform(transform)
    return env


def _worker_env_config(config: TrainingConfig, worker: int, session: int) -> EnvConfig:
    env, rovers = config.env, config.rovers_per_worker
    backend = env.backend
    if backend in ("mujoco", "warp"):
        # The workers share the cores. Networks of this size need only one thread per worker.
        settings = find_settings(backend).preset(training_physics(config))
        backend = replace(settings, threads=max(1, usable_cores() // config.workers))
    return replace(
        env,
        physics=DEFAULT_PHYSICS,
        sensors=_sensors(config),
        num_envs=rovers,
        seed=config.seed + worker * rovers + session * SESSION_SEEDS,
        backend=backend,
        privileged=env.privileged or config.network.privileged_critic,
        # On the CPU, tensordicts without a device are faster.
        device=config.device if config.on_gpu else None,
    )


def training_physics(config: TrainingConfig) -> str:
    """Preset of the physics that a training takes: that of its settings, or by default the fastest that fits.

    It is ``"planar"`` in Warp if all worlds are level, of which ranges are told by some, and nothing is measured or
    seen that depends on how the body tilts.
    """
    env = config.env
    if env.backend != "warp" or env.physics != DEFAULT_PHYSICS:
        return env.physics
    # Importing NVIDIA Warp takes half a second.
    from rover_rl.sims.warp.planar.simulator import PlanarSimulator, planar_problem

    sensors = own_sensors(_sensors(config)).values()
    measured = {need for sensor in sensors for need in sensor.needs}
    if measured - PlanarSimulator.features or any(isinstance(sensor, PixelImage) for sensor in sensors):
        return DEFAULT_PHYSICS
    worlds = WorldPool.of(env.world).some()
    return DEFAULT_PHYSICS if planar_problem(worlds, get_robots(env.robot)) else "planar"


def _sensors(config: TrainingConfig) -> tuple[SensorLike, ...]:
    read = {*config.network.observation, *find_action(config.env.action.kind).needs}
    sensors = own_sensors(with_sensors(config.env, [*read]).sensors)
    for key, sensor in sensors.items():
        if sensor.takes_long and key in read:
            sensors[key] = replace(sensor, period=config.collection.action_repeat)
    return tuple(sensors.values())
