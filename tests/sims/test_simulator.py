"""The Simulator interface, implemented by every simulation backend, and by the one that ``docs/backends.md`` builds."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import make_env
from rover_rl.sims import RoverState, Simulator, make_scanner
from rover_rl.sims.mujoco import MujocoSettings
from rover_rl.sims.warp import WarpSettings
from rover_rl.worlds import Terrain, World, box, get_world
from tests.extras import BACKENDS, needs_mujoco
from tests.sims.driven import FLAT, ROVER, WALLED, all_rows, drive, placed, slope

WARP_AND_MUJOCO = BACKENDS[1:]
FIELDS = ("position", "orientation", "linear_velocity", "angular_velocity", "stamp")


@pytest.fixture(params=[*BACKENDS, "guide"])
def backend(request: pytest.FixtureRequest) -> str:
    """Name of a backend, or the import path of the page's."""
    return request.getfixturevalue("guide") if request.param == "guide" else request.param


def differences(a: RoverState, b: RoverState, row: int, other: int) -> list[str]:
    """Returns the names of the fields in which row ``row`` of ``a`` and row ``other`` of ``b`` differ in any bit."""
    return [name for name in FIELDS if not torch.equal(getattr(a, name)[row], getattr(b, name)[other])]


def test_backend_implements_the_simulator_interface(backend):
    simulator = placed(backend, FLAT, torch.zeros(3, 3))
    assert isinstance(simulator, Simulator)
    state = simulator.state()
    assert state.batch_size == (3,)
    shapes = {"position": 3, "orientation": 4, "linear_velocity": 1, "angular_velocity": 1, "dt": 1, "stamp": 1}
    for name, width in shapes.items():
        assert getattr(state, name).shape == (3, width)
        assert getattr(state, name).dtype == (torch.float64 if name == "stamp" else torch.float32)
    torch.testing.assert_close(state.dt, torch.full((3, 1), 0.05))
    ranges = make_scanner(simulator, [FLAT] * 3, ROVER, beams=8).scan()
    assert (ranges.shape, ranges.dtype) == ((3, 8), torch.float32)
    if "contacts" in simulator.features:
        assert (state.contact.shape, state.contact.dtype) == ((3, 1), torch.bool)


def test_environments_match_their_specs_with_rows_in_several_worlds(backend):
    env = make_env(backend=backend, world_n=[FLAT, "maze"], num_envs=5, seed=0, lidar_beams=32)
    check_env_specs(env, break_when_any_done="both")
    env.close()


def test_reset_changes_only_the_selected_rows_and_no_returned_state(backend):
    simulator = placed(backend, [FLAT, WALLED, FLAT], [[0.0, 0, 0], [-2.0, 0, 0], [4.0, 0, 0]])
    states = drive(simulator, (1.0, 0.5), 10)
    copies = [state.clone() for state in states]
    poses = torch.full((3, 3), math.nan)
    poses[1] = torch.tensor([1.0, 2.0, 0.0])
    after = simulator.reset(torch.tensor([False, True, False]), poses)
    assert [differences(after, states[-1], row, row) for row in (0, 2)] == [[], []]
    torch.testing.assert_close(after.position[1, :2], torch.tensor([1.0, 2.0]), atol=1e-3, rtol=0)
    assert after.linear_velocity[1] == after.angular_velocity[1] == 0
    drive(simulator, (1.0, 0.0), 5)
    assert all((state == copy).all() for state, copy in zip(states, copies, strict=True))


def test_a_scan_depends_on_the_pose_alone_and_is_renewed_for_the_given_rows(backend):
    world, first = get_world("maze"), torch.tensor([True, False, False])
    poses = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, 1.0], [0.0, 0.5, 2.0]])
    simulator = placed(backend, world, poses)
    scanner = make_scanner(simulator, [world] * 3, ROVER, beams=32)
    before = scanner.scan()
    simulator.reset(first, poses + torch.tensor((0.3, 0.2, 0.0)))
    for elsewhere in (scanner.scan(first), scanner.scan()):
        assert not torch.equal(elsewhere[0], before[0])
        assert torch.equal(elsewhere[1:], before[1:])
    simulator.reset(first, poses)
    assert torch.equal(scanner.scan(), before)


def test_no_time_passes_for_inactive_rows(backend):
    simulator, alone = (placed(backend, FLAT, [[3.0 * k, 0, 0] for k in range(rows)]) for rows in (2, 1))
    before = drive(simulator, (1.0, 0.0), 10)[-1]
    for _ in range(10):
        held = simulator.step(torch.tensor([[1.0, 0.0]] * 2), torch.tensor([True, False]))
    assert differences(held, before, 1, 1) == []
    assert differences(held, drive(alone, (1.0, 0.0), 20)[-1], 0, 0) == []
    assert held.position[0, 0] > before.position[0, 0] + 0.4
    (after,) = drive(simulator, (1.0, 0.0), 1)
    # It continues at its previous speed.
    assert after.position[1, 0] - before.position[1, 0] == pytest.approx(0.05, abs=0.005)


def test_rows_equal_single_rovers_bit_for_bit(backend):
    ramp = slope(10, size=16)
    worlds = [ramp] * 9 + [get_world("maze")] * 4 + [ramp] * 3
    generator = torch.Generator().manual_seed(0)
    poses = torch.rand(16, 3, generator=generator) * 6 - 3
    commands = torch.rand(12, 16, 2, generator=generator) * torch.tensor([0.5, 2.0]) + torch.tensor([0.5, -1.0])
    batch = placed(backend, worlds, poses)
    start, together = batch.state(), [batch.step(command) for command in commands][-1]
    scans = make_scanner(batch, worlds, ROVER, beams=8).scan()
    # Most of them drive; the others stand in front of an obstacle and turn.
    assert ((together.position - start.position).norm(dim=-1) > 0.2).sum() > 8
    for row in (8, 9, 15):
        alone = placed(backend, worlds[row : row + 1], poses[row : row + 1])
        # Earlier episodes leave no trace, except in the clock.
        drive(alone, (1.0, 0.5), 3)
        alone.reset(all_rows(1), poses[row : row + 1])
        state = [alone.step(command[row : row + 1]) for command in commands][-1]
        assert differences(state, together, 0, row) == ["stamp"]
        assert torch.equal(make_scanner(alone, worlds[row : row + 1], ROVER, beams=8).scan()[0], scans[row])


@pytest.mark.parametrize("backend", WARP_AND_MUJOCO)
def test_results_do_not_depend_on_held_steps(backend):
    held, free = placed(backend, FLAT, torch.zeros(2, 3)), placed(backend, FLAT, torch.zeros(1, 3))
    for _ in range(10):
        drive(held, (0.5, 0.5), 1)
        held.step(torch.tensor([[1.0, 0.0]] * 2), torch.tensor([True, False]))
        (state,) = drive(free, (0.5, 0.5), 1)
    assert torch.equal(held.state().position[1], state.position[0])


@pytest.mark.parametrize(
    ("settings", "worlds", "rows"),
    [
        (WarpSettings(), ["inspect", "maze", "moon", "plaza"], 100),
        (WarpSettings.preset("planar"), ["maze:0-9", "plaza"], 100),
        pytest.param(MujocoSettings(), ["inspect", "maze", "moon", "plaza"], 16, marks=needs_mujoco),
    ],
    ids=["warp", "planar", "mujoco"],
)
def test_results_do_not_depend_on_the_number_of_threads(settings, worlds, rows):
    rollouts = []
    for threads in (1, 2, 3):
        backend = replace(settings, threads=threads)
        env = make_env(backend=backend, world_n=worlds, num_envs=rows, seed=1, length=15)
        torch.manual_seed(0)
        rollouts.append(env.rollout(25, break_when_any_done=False))
        env.close()
    assert rollouts[0]["next", "done"].any()
    for other in rollouts[1:]:
        assert (rollouts[0] == other).all()


@pytest.mark.parametrize("backend", WARP_AND_MUJOCO)
def test_the_height_of_the_edge_continues_outside_the_terrain(backend):
    plain, far = Terrain.flat((8, 8)), box((30.0, 30.0, 0.5), (1.0, 1.0, 1.0))
    triangles = Terrain(torch.tensor([[0.0, 0.0, 0.01]] * 3), 4.0)
    worlds = [World("plain", plain), World("outside", plain, [far]), World("triangles", triangles)]
    simulator = placed(backend, worlds, [[3.0, 0.0, 0.0], [3.0, 3.0, 1.0], [3.0, 0.0, 0.0]])
    assert torch.isinf(make_scanner(simulator, worlds, ROVER, beams=16).scan()).all()
    state = drive(simulator, (1.0, 0.0), 100)[-1]
    assert (state.position[[0, 2], 0] > 5.5).all()
    assert (state.position[:, 2].abs() < 0.02).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_pictures_are_of_each_rovers_world_in_two_views_also_after_close(backend):
    sim = placed(backend, [FLAT, WALLED, FLAT], torch.zeros(3, 3))
    flat, other, same = (sim.render(row, "chase", 64, 48, torch.tensor([1.0, 0.0])) for row in range(3))
    assert (flat.shape, flat.dtype) == ((48, 64, 3), torch.uint8)
    assert flat.float().std() > 5
    assert not torch.equal(flat, other)
    assert torch.equal(flat, same)
    assert not torch.equal(flat, sim.render(0, "top", 64, 48))
    sim.close()
    sim.close()
    assert torch.equal(sim.render(0, "chase", 64, 48, torch.tensor([1.0, 0.0])), flat)
    sim.close()
