from __future__ import annotations

import torch

from rover_rl import RoverEnv
from rover_rl.envs.transforms.step_clock import StepClock


def test_the_clock_goes_with_the_data() -> None:
    base = RoverEnv(world_n="maze", num_envs=3, seed=0)
    env = base.append_transform(StepClock(base))
    rollout = env.rollout(5, break_when_any_done=False)
    simulator, environment = (rollout["next", "clock", name].squeeze(-1) for name in ("simulator", "environment"))
    assert simulator.dtype == torch.float64
    assert (simulator == simulator[:1]).all()
    assert (simulator.diff(dim=1) > 0).all()
    # Each step is longer than what the simulator does in it, and so is the reset before the first.
    assert (environment.diff(dim=1) > simulator.diff(dim=1)).all()
    assert (environment > simulator).all()
