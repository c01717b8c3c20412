"""The Simulator interface, implemented by every simulation backend."""

from __future__ import annotations

import pytest
import torch

from rover_rl.sims import Simulator, make_scanner, make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain, World, box, get_world
from tests.extras import needs_mujoco

ROVER = get_robot("rover_zero")
FLAT = World("flat", Terrain.flat((20, 20)))


def simulator(backend, worlds):
    return make_simulator(backend, worlds=worlds, robot=ROVER)


def all_rows(count):
    return torch.ones(count, dtype=torch.bool)


def test_backend_implements_the_simulator_interface(backend):
    assert isinstance(simulator(backend, [FLAT]), Simulator)


def test_state_has_the_shapes_and_dtypes_of_the_interface(backend):
    state = simulator(backend, [FLAT] * 3).state()
    assert state.batch_size == (3,)
    shapes = {"position": 3, "orientation": 4, "linear_velocity": 1, "angular_velocity": 1, "dt": 1, "stamp": 1}
    for name, width in shapes.items():
        assert getattr(state, name).shape == (3, width)
        assert getattr(state, name).dtype == (torch.float64 if name == "stamp" else torch.float32)
    torch.testing.assert_close(state.dt, torch.full((3, 1), 0.05))
    assert (state.contact.shape, state.contact.dtype) == ((3, 1), torch.bool)


def test_returned_states_do_not_change(backend):
    sim = simulator(backend, [FLAT])
    first = sim.step(torch.tensor([[1.0, 0.0]]))
    copy = first.clone()
    for _ in range(5):
        sim.step(torch.tensor([[1.0, 0.0]]))
    assert (first == copy).all()


def test_reset_changes_only_the_selected_rows(backend):
    sim = simulator(backend, [FLAT] * 3)
    poses = torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [4.0, 0, 0]])
    sim.reset(all_rows(3), poses)
    scanner = make_scanner(sim, [FLAT] * 3, ROVER, beams=8)
    for _ in range(10):
        before = sim.step(torch.tensor([[1.0, 0.5]] * 3))
    scan, only = scanner.scan(), torch.tensor([False, True, False])
    after = sim.reset(only, poses)
    assert torch.equal(scanner.scan(only)[[0, 2]], scan[[0, 2]])
    for row in (0, 2):
        assert torch.equal(after.position[row], before.position[row])
    assert after.position[1, 0] == pytest.approx(2.0, abs=1e-3)
    assert after.linear_velocity[1] == 0


def test_no_time_passes_for_inactive_rows(backend):
    sim = simulator(backend, [FLAT] * 2)
    sim.reset(all_rows(2), torch.tensor([[0.0, 0, 0], [3.0, 0, 0]]))
    for _ in range(10):
        before = sim.step(torch.tensor([[1.0, 0.0]] * 2))
    for _ in range(10):
        held = sim.step(torch.tensor([[1.0, 0.0]] * 2), torch.tensor([True, False]))
    assert torch.equal(held.position[1], before.position[1])
    assert held.stamp[1] == before.stamp[1]
    assert held.position[0, 0] > before.position[0, 0] + 0.4
    after = sim.step(torch.tensor([[1.0, 0.0]] * 2))
    # It continues at its previous speed.
    assert after.position[1, 0] - before.position[1, 0] == pytest.approx(0.05, abs=0.005)


def test_rows_may_be_in_different_worlds(backend):
    walled = World("walled", Terrain.flat((20, 20)), [box((3, 0, 1), (1, 10, 2))])
    worlds = [FLAT, FLAT, walled]
    sim = simulator(backend, worlds)
    sim.reset(all_rows(3), torch.zeros(3, 3))
    ranges = make_scanner(sim, worlds, ROVER, beams=8).scan()
    assert (ranges.shape, ranges.dtype) == ((3, 8), torch.float32)
    assert torch.isinf(ranges[:2, 0]).all()
    assert ranges[2, 0] == pytest.approx(2.5 - 0.174, abs=0.01)


def test_render_has_a_chase_view_and_a_top_view(backend):
    sim = simulator(backend, [get_world("moon")])
    for view in ("chase", "top"):
        image = sim.render(0, view, 64, 48, torch.tensor([1.0, 1.0]))
        assert image.shape == (48, 64, 3)
        assert image.dtype == torch.uint8
        assert image.float().std() > 5
    with pytest.raises(ValueError, match=r"unknown view 'side'.*'chase' or 'top'"):
        sim.render(0, "side", 64, 48)
    sim.close()


def test_rendering_after_close_and_in_several_worlds(backend):
    walled = World("walled", Terrain.flat((20, 20)), [box((3, 0, 1), (1, 10, 2))])
    sim = simulator(backend, [FLAT, walled, FLAT])
    flat, other, same = (sim.render(row, "chase", 64, 48, torch.tensor([1.0, 0.0])) for row in range(3))
    assert not torch.equal(flat, other)
    assert torch.equal(flat, same)
    sim.close()
    sim.close()
    assert torch.equal(sim.render(0, "chase", 64, 48, torch.tensor([1.0, 0.0])), flat)
    sim.close()


@needs_mujoco
def test_all_backends_render_the_same_image():
    images = []
    for name in ("bullet", "warp", "mujoco"):
        sim = simulator(name, [FLAT])
        sim.reset(all_rows(1), torch.tensor([[1.0, 2.0, 0.5]]))
        images.append(sim.render(0, "chase", 64, 48, torch.tensor([2.0, 2.0])).float())
        sim.close()
    assert (images[0] - images[1]).abs().mean() < 1
    assert (images[0] - images[2]).abs().mean() < 1
