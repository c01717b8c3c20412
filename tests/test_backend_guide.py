"""The backend of ``docs/backends.md`` does what the page asks."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from rover_rl import RoverEnv, make_env
from rover_rl.envs.config import Randomization
from rover_rl.sims import RoverState, Simulator, make_scanner, make_simulator
from rover_rl.sims.robots import get_robot
from rover_rl.sims.worlds import Terrain, World, box, get_world
from tests.pages import ROOT, blocks

BACKEND, *_ = blocks((ROOT / "docs" / "backends.md").read_text(), "python")

ROVER = get_robot("rover_zero")
MOUNT = ROVER.lidar_position[0]
FLAT = World("flat", Terrain.flat((20, 20)))
WALLED = World("walled", Terrain.flat((20, 20)), [box((3, 0, 1), (1, 10, 2))])
FIELDS = ("position", "orientation", "linear_velocity", "angular_velocity", "stamp")


@pytest.fixture
def backend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own_registries: None) -> str:
    """Path of the page's backend, in a module of its own."""
    (tmp_path / "guide_backend.py").write_text(BACKEND.code)
    monkeypatch.syspath_prepend(tmp_path)
    return "guide_backend:Kinematic"


def simulator(backend: str, worlds: list[World]) -> Simulator:
    return make_simulator(backend, worlds=worlds, robot=ROVER)


def all_rows(count: int) -> torch.Tensor:
    return torch.ones(count, dtype=torch.bool)


def drive(sim: Simulator, command: tuple[float, float], steps: int) -> RoverState:
    for _ in range(steps):
        state = sim.step(torch.tensor([command] * sim.num_envs))
    return state


def rows_differ(a: RoverState, b: RoverState, row: int, other: int | None = None) -> list[str]:
    """Returns the names of the fields in which row ``row`` of ``a`` and row ``other`` of ``b`` differ in any bit."""
    other = row if other is None else other
    return [name for name in FIELDS if not torch.equal(getattr(a, name)[row], getattr(b, name)[other])]


def test_a_turn_is_a_circle(backend):
    sim = simulator(backend, [FLAT])
    drive(sim, (0.5, 1.0), 20)
    start = sim.state()
    steps = round(2 * math.pi / sim.control_dt)
    end = drive(sim, (0.5, 1.0), steps)
    assert end.angular_velocity.item() == pytest.approx(1.0, abs=1e-4)
    # A full turn ends within a step of its start, and half a turn later the rover is a diameter away.
    assert (end.position - start.position).norm() < 0.5 * sim.control_dt
    half = drive(sim, (0.5, 1.0), steps // 2)
    assert (half.position - end.position).norm().item() == pytest.approx(2 * 0.5 / 1.0, rel=0.01)


def test_the_lidar_measures_the_distance_to_a_wall(backend):
    sim = simulator(backend, [WALLED] * 3)
    poses = torch.tensor([[0.0, 0.0, 0.0], [0.5, 0.0, math.pi / 4], [3.0, 0.0, 0.0]])
    sim.reset(all_rows(3), poses)
    ranges = make_scanner(sim, [WALLED] * 3, ROVER, beams=8).scan()
    # The wall's face is at x = 2.5; beams are 45 degrees apart.
    ahead = 2.5 - MOUNT
    diagonal = math.sqrt(2) * ahead
    inf = math.inf
    expected = torch.tensor([ahead, diagonal, inf, inf, inf, inf, inf, diagonal])
    torch.testing.assert_close(ranges[0], expected, atol=1e-5, rtol=0)
    x = 0.5 + MOUNT * math.sqrt(0.5)
    assert ranges[1, 7].item() == pytest.approx(2.5 - x, abs=1e-5)
    assert ranges[1, 0].item() == pytest.approx(math.sqrt(2) * (2.5 - x), abs=1e-5)
    assert (ranges[2] == 0).all()


def test_a_wall_stops_the_body_and_not_the_wheels(backend):
    sim = simulator(backend, [WALLED])
    stopped = drive(sim, (1.0, 0.0), 80)
    # It stops within a step of the pose in which the beam ahead is as long as the rover's radius.
    assert 0 <= stopped.position[0, 0] - (2.5 - MOUNT - ROVER.radius) < 1.0 * sim.control_dt
    assert torch.equal(drive(sim, (1.0, 0.0), 1).position, stopped.position)
    assert stopped.linear_velocity.item() == pytest.approx(1.0, abs=1e-4)
    assert drive(sim, (-1.0, 0.0), 20).position[0, 0] < stopped.position[0, 0] - 0.5


def test_a_partial_reset_touches_only_its_rows(backend):
    sim = simulator(backend, [FLAT, WALLED, FLAT])
    sim.reset(all_rows(3), torch.tensor([[0.0, 0, 0], [-2.0, 0, 0], [4.0, 0, 0]]))
    before = drive(sim, (1.0, 0.5), 10)
    copy = before.clone()
    poses = torch.full((3, 3), math.nan)
    poses[1] = torch.tensor([1.0, 2.0, 0.0])
    after = sim.reset(torch.tensor([False, True, False]), poses)
    assert [rows_differ(before, after, row) for row in (0, 2)] == [[], []]
    torch.testing.assert_close(after.position[1, :2], torch.tensor([1.0, 2.0]))
    assert after.linear_velocity[1] == after.angular_velocity[1] == 0
    # What has been returned does not change.
    assert (before == copy).all()


def test_no_time_passes_for_inactive_rows(backend):
    sim = simulator(backend, [FLAT] * 2)
    before = drive(sim, (1.0, 0.3), 10)
    for _ in range(5):
        held = sim.step(torch.tensor([[1.0, 0.3]] * 2), torch.tensor([True, False]))
    assert rows_differ(held, before, 1) == []
    assert {"position", "orientation", "stamp"} <= set(rows_differ(held, before, 0))
    after = drive(sim, (1.0, 0.3), 1)
    # It continues at its previous speed.
    assert (after.position[1] - before.position[1]).norm().item() == pytest.approx(0.05, abs=1e-3)


def test_rows_equal_single_rovers_bit_for_bit(backend):
    worlds = [get_world("moon")] * 9 + [get_world("maze")] * 4 + [get_world("moon")] * 3
    generator = torch.Generator().manual_seed(0)
    poses = torch.rand(16, 3, generator=generator) * 6 - 3
    commands = torch.rand(12, 16, 2, generator=generator) * torch.tensor([0.5, 2.0]) + torch.tensor([0.5, -1.0])
    batch = simulator(backend, worlds)
    start = batch.reset(all_rows(16), poses)
    for command in commands:
        together = batch.step(command)
    # Most of them drive; the others stand in front of an obstacle and turn.
    assert ((together.position - start.position).norm(dim=-1) > 0.2).sum() > 8
    for row in (0, 8, 9, 15):
        alone = simulator(backend, worlds[row : row + 1])
        # Earlier episodes leave no trace, except in the clock.
        drive(alone, (1.0, 0.5), 3)
        alone.reset(all_rows(1), poses[row : row + 1])
        for command in commands:
            state = alone.step(command[row : row + 1])
        assert rows_differ(state, together, 0, row) == ["stamp"]


def test_environment_specs_and_rendering(backend):
    env = make_env(backend=backend, world_n=["inspect", "maze"], num_envs=4, lidar_beams=32, seed=0)
    check_env_specs(env)
    env.reset()
    image = env.base_env.render(3, width=32, height=24)
    assert image.shape == (24, 32, 3)
    assert image.float().std() > 1
    env.close()
    env.reset()
    with pytest.raises(ValueError, match="friction, mass and motors need a backend .*'dynamics'$"):
        RoverEnv(world_n="maze", backend=backend, randomization=Randomization(friction=(0.5, 1.0)))
