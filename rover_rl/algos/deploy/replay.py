"""Recorded drives as transitions of the environment, which computes observations, rewards and endings itself."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_rl.algos.deploy.recorded_drives import Drives, RecordedDrive, place_of
from rover_rl.envs.config import ActionConfig, EnvConfig, LidarConfig
from rover_rl.envs.gym import GymWrapper
from rover_rl.envs.make import make_env
from rover_rl.rotations import euler_to_matrix, matrix_to_quaternion
from rover_rl.sims import RoverState, Simulator
from rover_rl.sims.rover_state import beam_angles
from rover_rl.sims.settings import CONTROL_DT


class Replay(Simulator):
    """Backend, simulator and lidar that go through the samples of a drive, whatever is commanded."""

    num_envs, control_dt, device = 1, CONTROL_DT, torch.device("cpu")
    features = frozenset({"contacts", "lidar"})

    def __init__(self, drive: RecordedDrive) -> None:
        self._drive, self._index, self.angles = drive, 0, beam_angles(len(drive.samples[0].ranges)).float()

    def make(self, **_: Any) -> Replay:
        return self

    def scanner(self, beams: int) -> Replay:
        return self

    def scan(self, rows: Tensor | None = None) -> Tensor:
        return self._drive.samples[self._index].ranges[None].float()

    def reset(self, mask: Tensor, poses: Tensor) -> RoverState:
        self._index = 0
        return self.state()

    def step(self, commands: Tensor, active: Tensor | None = None) -> RoverState:
        self._index += 1
        return self.state()

    def state(self) -> RoverState:
        sample = self._drive.samples[self._index]
        return RoverState.pack(
            position=torch.tensor([sample.position]),
            orientation=matrix_to_quaternion(euler_to_matrix(torch.tensor([sample.angles]))),
            linear_velocity=torch.tensor([sample.wheels[:1]]),
            angular_velocity=torch.tensor([sample.wheels[1:]]),
            dt=torch.tensor([[sample.dt or CONTROL_DT]]),
            stamp=torch.tensor([[self._drive.times[self._index]]], dtype=torch.float64),
            contact=torch.zeros(1, 1, dtype=torch.bool),
        )


def transitions(bag: Drives) -> Iterator[tuple[GymWrapper, dict[str, Any]]]:
    """Yields the environment of each drive that has a step, and the drive as the fields of Minari's ``EpisodeBuffer``.

    Actions are the commands that were sent, m/s and rad/s. The last step is truncated if it does not end the episode.
    Raises ``ValueError`` for bags that ``rover-rl drive`` has not recorded, or without wheel odometry.
    """
    for drive in (drive for drive in bag.drives if len(drive.samples) > 1):
        actions = np.array([sample.command for sample in drive.samples[1:]], dtype=np.float32)
        if not np.isfinite([*actions, *(sample.wheels for sample in drive.samples)]).all():
            raise ValueError("a data set needs bags of rover-rl drive with wheel odometry: see --topics.odometry")
        place: Any = {"world": place_of(bag.world, [drive]), "robot": bag.robot, "backend": Replay(drive)}
        lidar, action = LidarConfig(beams=len(drive.samples[0].ranges)), ActionConfig(kind="twist")
        env = GymWrapper(make_env(EnvConfig(**place, lidar=lidar, action=action, end_on_goal=True, length=10**9)))
        observations, rows = [env.reset(options={"goal": drive.goal})[0]], list[tuple[float, bool]]()
        for command in actions:
            observation, reward, terminated, *_ = env.step(command)
            observations.append(observation)
            rows.append((reward, terminated))
            if terminated:
                break
        env.close()
        rewards, terminations = map(list, zip(*rows, strict=True))
        yield (
            env,
            {
                "observations": {name: np.stack([each[name] for each in observations]) for name in observations[0]},
                "actions": actions[: len(rows)],
                "rewards": rewards,
                "terminations": terminations,
                "truncations": [*[False] * (len(rows) - 1), not terminations[-1]],
            },
        )
