"""Rovers among movers do not depend on their company, to the last bit, in every simulator."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.warp import WarpSettings
from tests.extras import needs_mujoco
from tests.sims.movers.scenes import act, crowd, opened, place

ROWS, STEPS = 66, 20
_generator = torch.Generator().manual_seed(1)
STARTS = torch.rand(ROWS, 3, generator=_generator) * 2 - 1
ACTIONS = torch.rand(STEPS, ROWS, 2, generator=_generator) * 2 - 1


def drive(env, rows: slice, steps: int = STEPS) -> Tensor:
    """What happens in some steps of the rows, ``[n, steps, ...]``."""
    found = []
    for actions in ACTIONS[:steps]:
        act(env, actions[rows])
        state = env.rover_state
        found.append(torch.cat((state.position, state.orientation, state.contact, state.mover_contact, env.scan), -1))
    return torch.stack(found, 1)


def driven(backend, rows: slice, steps: int = STEPS, random_start: bool = True) -> Tensor:
    with opened(crowd(10, random_start), STARTS[rows].tolist(), backend=backend, seed=rows.start) as env:
        return drive(env, rows, steps)


def test_rows_do_not_depend_on_other_rows(backend):
    # In Bullet, rovers beyond the 64th have a client of their own.
    together = driven(backend, slice(0, ROWS), 12)
    assert together[..., 8].any()
    for rows in (slice(3, 4), slice(62, 66)):
        assert torch.equal(together[rows], driven(backend, rows, 12))


@pytest.mark.parametrize(
    "settings", [WarpSettings, pytest.param(MujocoSettings, marks=needs_mujoco)], ids=["warp", "mujoco"]
)
def test_rows_do_not_depend_on_the_number_of_threads(settings):
    rows = slice(0, 32)
    assert torch.equal(driven(settings(threads=1), rows), driven(settings(threads=2), rows))


def test_an_episode_does_not_depend_on_earlier_ones(backend):
    rows = slice(0, 3)
    with opened(crowd(10, False), STARTS[rows].tolist(), backend=backend) as env:
        first = drive(env, rows)
        assert first[..., 8].any()
        for episode in range(19):
            place(env, STARTS[rows].roll(episode + 1, 0).tolist())
            drive(env, rows, 2)
        place(env, STARTS[rows].tolist())
        assert torch.equal(drive(env, rows), first)


def test_no_time_passes_for_movers_of_held_rows(backend):
    rows, held = slice(0, 4), torch.tensor([False, True, False, True])
    with opened(crowd(10, False), STARTS[rows].tolist(), backend=backend) as env:
        drive(env, rows, 6)
        before, contact = env.rover_state.position.clone(), env.rover_state.mover_contact.clone()
        places = env.movers.parts.position.clone()
        for _ in range(3):
            act(env, ACTIONS[0, rows], ~held)
        assert torch.equal(env.rover_state.position[held], before[held])
        assert torch.equal(env.rover_state.mover_contact[held], contact[held])
        assert torch.equal(env.movers.parts.position[held], places[held])
        assert (env.rover_state.position[~held] != before[~held]).any(-1).all()


@pytest.mark.parametrize("simulator", ["warp", pytest.param("mujoco", marks=needs_mujoco)])
def test_held_rows_go_on_as_if_they_had_not_been_held(simulator):
    rows = slice(0, 4)
    held = torch.tensor([False, True, False, True])
    expected = driven(simulator, rows, 10)
    with opened(crowd(10, True), STARTS[rows].tolist(), backend=simulator) as env:
        for step in range(10):
            for mask in (held, ~held):
                act(env, ACTIONS[step, rows], mask)
            position = torch.cat((env.rover_state.position, env.rover_state.orientation), -1)
            assert torch.equal(position, expected[:, step, :7])
