"""The duration of a step is the simulator's, and everything else reads it there."""

from __future__ import annotations

import pytest
import torch

from rover_rl import GymVectorWrapper, GymWrapper, RoverEnv
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.envs import EnvConfig
from rover_rl.sims.bullet import BulletSettings

TEN_HERTZ = BulletSettings(control_dt=0.1, substeps=20)


def test_an_environment_reads_it_from_its_simulator():
    env = RoverEnv(world_n="maze", backend=TEN_HERTZ)
    assert env.control_dt == env.simulator.control_dt == 0.1
    assert RoverEnv(world_n="maze").control_dt == 0.05
    env.reset()
    assert env.rover_state.dt.item() == pytest.approx(0.1)


def test_wrappers_give_the_frame_rate():
    assert GymWrapper(RoverEnv(world_n="maze", backend=TEN_HERTZ)).metadata["render_fps"] == 10
    assert GymVectorWrapper(RoverEnv(world_n="maze", backend=TEN_HERTZ)).metadata["render_fps"] == 10
    assert GymWrapper.metadata["render_fps"] == 20


def test_evaluations_measure_in_seconds():
    def ahead(td):
        return td.set("action", torch.tensor([[0.5, 0.0]]).expand(len(td), 2))

    episodes = draw_episodes("maze", 2, seed=0)
    slow, fast = (
        evaluate(ahead, episodes, seconds=1.0, env=EnvConfig(backend=backend)) for backend in (TEN_HERTZ, "bullet")
    )
    assert slow.steps.tolist() == [10, 10]
    assert fast.steps.tolist() == [20, 20]
    assert [t.seconds for t in slow.trajectories] == pytest.approx([1.0, 1.0])
    torch.testing.assert_close(slow.paths[0][-1], fast.paths[0][-1], atol=0.05, rtol=0)
