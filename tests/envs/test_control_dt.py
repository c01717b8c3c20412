"""The duration of a step is the simulator's, and everything else reads it there."""

from __future__ import annotations

import pytest
import torch

from rover_rl import GymVectorWrapper, GymWrapper, RoverEnv
from rover_rl.algos.evaluation.episodes import draw_episodes
from rover_rl.algos.evaluation.evaluate import evaluate
from rover_rl.envs.config import EnvConfig
from rover_rl.robots import get_robot
from rover_rl.sims import make_simulator
from rover_rl.sims.bullet import BulletSettings
from rover_rl.worlds import get_world
from tests.extras import BACKENDS


class Own:
    """A backend without settings."""

    def make(self, **arguments):
        return make_simulator("bullet", **arguments)


TEN_HERTZ = BulletSettings(control_dt=0.1, substeps=20)


def test_an_environment_reads_it_from_its_simulator():
    env = RoverEnv(world_n="maze", backend=TEN_HERTZ)
    assert env.control_dt == env.simulator.control_dt == 0.1
    assert RoverEnv(world_n="maze").control_dt == 0.05
    env.reset()
    assert env.rover_state.dt.item() == pytest.approx(0.1)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_control_rate_changes_the_step_of_any_simulator_and_not_that_of_its_physics(backend):
    rates = {"world_n": "maze", "backend": backend, "seed": 0}
    env, default, twenty = (RoverEnv(control_rate=rate, **rates) for rate in (40.0, None, 20.0))
    assert env.control_dt == env.config.control_dt == 0.025
    assert env.simulator.settings.substep <= default.simulator.settings.substep
    env.rollout(20, lambda td: td.set("action", torch.tensor([[0.5, 0.0]])))
    assert env.rover_state.stamp.item() == pytest.approx(0.5)
    paths = [each.rollout(5, lambda td: td.set("action", torch.tensor([[0.5, 0.5]]))) for each in (twenty, default)]
    assert torch.equal(paths[0]["pose"], paths[1]["pose"])


def test_a_control_rate_is_refused_where_it_cannot_be():
    with pytest.raises(ValueError, match="control_rate must be positive and at most 1000, got 0"):
        EnvConfig(control_rate=0.0)
    with pytest.raises(ValueError, match="control_rate needs a backend whose settings have a control_dt"):
        make_simulator(Own(), worlds=[get_world("maze")], robot=get_robot("rover_zero"), control_rate=40.0)


def test_wrappers_give_the_frame_rate():
    for wrapper in (GymWrapper, GymVectorWrapper):
        assert wrapper(RoverEnv(world_n="maze", backend=TEN_HERTZ)).metadata["render_fps"] == 10
    assert GymWrapper.metadata["render_fps"] == 20


def test_evaluations_measure_in_seconds():
    def ahead(td):
        return td.set("action", torch.tensor([[0.5, 0.0]]).expand(len(td), 2))

    episodes = draw_episodes("maze", 2, seed=0)
    slow, fast = (
        evaluate(ahead, episodes, seconds=1.0, env=EnvConfig(backend=backend)) for backend in (TEN_HERTZ, "bullet")
    )
    assert [*map(len, slow.trajectories)] == [10, 10]
    assert [*map(len, fast.trajectories)] == [20, 20]
    assert [t.seconds for t in slow.trajectories] == pytest.approx([1.0, 1.0])
    torch.testing.assert_close(slow.paths[0][-1], fast.paths[0][-1], atol=0.05, rtol=0)
