"""Rovers among movers do not depend on their company, to the last bit, in every simulator."""

from __future__ import annotations

import torch
from torch import Tensor

from tests.sims.movers.scenes import act, crowd, opened, place

ROWS, STEPS = 66, 10
_generator = torch.Generator().manual_seed(1)
STARTS = torch.rand(ROWS, 3, generator=_generator) * 2 - 1
ACTIONS = torch.rand(STEPS, ROWS, 2, generator=_generator) * 2 - 1


def happened(env) -> Tensor:
    state = env.rover_state
    return torch.cat((state.position, state.orientation, state.contact, state.mover_contact, env.scan), -1)


def drive(env, rows: slice, steps: int = STEPS) -> Tensor:
    """What happens in some steps of the rows, ``[n, steps, ...]``."""
    found = []
    for actions in ACTIONS[:steps]:
        act(env, actions[rows])
        found.append(happened(env))
    return torch.stack(found, 1)


def driven(backend, rows: slice, random_start: bool = True) -> Tensor:
    with opened(crowd(10, random_start), STARTS[rows].tolist(), backend=backend, seed=rows.start) as env:
        return drive(env, rows)


def test_rows_do_not_depend_on_other_rows(backend):
    # In Bullet, rovers beyond the 64th have a client of their own.
    together = driven(backend, slice(0, ROWS))
    assert together[..., 8].any()
    assert torch.equal(together[62:], driven(backend, slice(62, 66)))


def test_an_episode_does_not_depend_on_earlier_ones_and_no_time_passes_in_held_rows(backend):
    rows, held = slice(0, 4), torch.tensor([False, True, False, True])
    with opened(crowd(10, False), STARTS[rows].tolist(), backend=backend) as env:
        first = drive(env, rows)
        assert first[..., 8].any()
        for episode in range(9):
            place(env, STARTS[rows].roll(episode + 1, 0).tolist())
            drive(env, rows, 2)
        place(env, STARTS[rows].tolist())
        assert torch.equal(drive(env, rows), first)
        place(env, STARTS[rows].tolist())
        for step in range(STEPS):
            # Half of the rows take each step first, and then the others do.
            before, places = happened(env), env.movers.parts.position.clone()
            act(env, ACTIONS[step, rows], ~held)
            assert torch.equal(happened(env)[held], before[held])
            assert torch.equal(env.movers.parts.position[held], places[held])
            act(env, ACTIONS[step, rows], held)
            # Bullet's contacts depend on its last step.
            assert backend == "bullet" or torch.equal(happened(env)[:, :7], first[:, step, :7])
