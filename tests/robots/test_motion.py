"""Robots drive, brake, turn and climb in every simulator as geometry and Coulomb's law have it."""

from __future__ import annotations

import math
from itertools import combinations

import pytest
import torch
from torch import Tensor

from benchmarks.coulomb import GRAVITY, steady_motion
from rover_rl.robots import ROBOTS, Robot, get_robot, get_robots
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.kinematics import Kinematics
from rover_rl.rotations import quaternion_to_euler
from tests.extras import needs_mujoco
from tests.robots.drives.vehicles import WHEELBASE, make_car, make_omni, make_pair
from tests.sims.driven import FLAT, ROVER, WALLED, placed, slope

NAMES = [name for name in ROBOTS if name != "rover_zero"]
DT, FRICTION = 0.05, 0.5
LAG = 0.012
"""Time by which a simulated rover may lag behind its set point, s."""
SECOND = round(1 / DT)


class Drive:
    """Poses of rovers that follow commands ``[T, N, 2 or 3]``: positions ``[T + 1, N, 2]`` and yaws ``[T + 1, N]``."""

    def __init__(self, backend: str, robot: Robot | Fleet, commands: Tensor) -> None:
        simulator = placed(backend, FLAT, torch.zeros(commands.shape[1], 3), robot)
        states = [simulator.state(), *(simulator.step(command) for command in commands)]
        simulator.close()
        self.position = torch.stack([state.position[:, :2] for state in states]).double()
        self.yaw = torch.stack([quaternion_to_euler(state.orientation)[:, 2] for state in states]).double()
        self.last = states[-1]

    def twist(self, steps: int = SECOND, ahead: float = 0.0) -> Tensor:
        """Mean forward speed and leftward speed of a point ``ahead``, and yaw rate, in the last steps: ``[N, 3]``."""
        yaw = self.yaw[-steps - 1 :]
        turn = torch.remainder(yaw.diff(dim=0) + math.pi, 2 * math.pi) - math.pi
        point = self.position[-steps - 1 :] + ahead * torch.stack((yaw.cos(), yaw.sin()), -1)
        chord, middle = point.diff(dim=0), yaw[:-1] + turn / 2
        # An arc is longer than its chord.
        arc = 1 / torch.sinc(turn / 2 / math.pi) / DT
        forward = (chord[..., 0] * middle.cos() + chord[..., 1] * middle.sin()) * arc
        left = (chord[..., 1] * middle.cos() - chord[..., 0] * middle.sin()) * arc
        return torch.stack((forward.mean(0), turn.mean(0) / DT, left.mean(0)), -1)

    def acceleration(self, row: int, ahead: float) -> float:
        """Largest mean acceleration in half a second of a point ``ahead`` of the origin, m/s^2."""
        yaw = self.yaw[:, row]
        point = self.position[:, row] + ahead * torch.stack((yaw.cos(), yaw.sin()), -1)
        size = (point.diff(dim=0).diff(dim=0) / DT**2).norm(dim=-1)
        return size.unfold(0, SECOND // 2, 1).mean(-1).max().item()


def held(*commands: tuple[float, ...], steps: int = 3 * SECOND) -> Tensor:
    return torch.tensor(commands).expand(steps, -1, -1)


def speeding_up(robot: Robot, speed: float) -> int:
    """Number of steps after which a robot has a speed for half a second."""
    return round(speed / robot.drive.max_linear_acceleration / DT) + SECOND // 2


def within(actual: Tensor, expected: Tensor, share: float = 0.02, floor: float = 0.5) -> None:
    torch.testing.assert_close(actual.double(), torch.as_tensor(expected).double(), rtol=share, atol=floor * share)


@pytest.mark.parametrize(
    ("backend", "name"),
    [*(("warp", name) for name in NAMES), ("bullet", "jackal"), pytest.param("mujoco", "hunter", marks=needs_mujoco)],
)
def test_a_robot_of_the_package_drives_brakes_and_turns_as_its_drive_says(backend: str, name: str) -> None:
    robot = get_robot(name)
    top, first = robot.drive.max_speed, speeding_up(robot, robot.drive.max_speed)
    straight = held((top, 0.0), (-top / 2, 0.0), steps=2 * first).clone()
    straight[first:, 0] = 0
    driven = Drive(backend, robot, straight)
    within(driven.twist(5)[1, :1], [-top / 2], share=0.05)
    # The way of braking is that of the limited commands.
    kinematics, set_point, law = Kinematics(Fleet.of(robot, 1), DT), torch.tensor([[top, 0.0]]), 0.0
    for _ in range(first):
        after = kinematics.advance(set_point, torch.zeros(1, 2))
        law, set_point = law + (set_point + after)[0, 0].item() / 2 * DT, after
    braking = (driven.position[-1] - driven.position[first])[0, 0].item()
    assert braking == pytest.approx(law, abs=0.05 * law + LAG * top)
    if robot.drive.turns_in_place:
        rates = [0.5 * robot.drive.max_yaw_rate, robot.drive.max_yaw_rate]
        balanced = [steady_motion(robot, robot.center_of_mass[0], 0.0, rate).yaw for rate in rates]
        turned = Drive(backend, robot, held(*((0.0, rate) for rate in rates))).twist()[:, 1]
        assert turned.tolist() == pytest.approx(balanced, rel=0.05)
        # The factor of the track that the makers of these robots found.
        assert balanced == pytest.approx(rates, rel=0.05)
    else:
        sharpest, rear = 1 / robot.drive.min_radius(robot.wheels), robot.drive.pivot(robot.wheels)
        motions = [(0.4, 0.5 * sharpest), (0.4, sharpest), (-0.3, -0.8 * sharpest)]
        turned = Drive(backend, robot, held(*((speed, speed * curve) for speed, curve in motions))).twist(ahead=rear)
        within(turned[:, 0] / turned[:, 1], [1 / curve for _, curve in motions])


def test_a_car_keeps_its_path_up_to_the_lateral_acceleration_that_friction_allows(backend: str) -> None:
    """Coulomb friction has no slip below its limit: a car follows its geometry up to ``mu g`` sideways.

    Beyond, no path is sharper than ``mu g`` allows, and the rear wheels, which drive as well, slide out.
    """
    robot, speed = get_robot("racer"), 2.5
    first, rear, center = speeding_up(robot, speed), robot.drive.pivot(robot.wheels), robot.center_of_mass[0]
    curvatures = torch.tensor([0.6, 0.9, 1.1]) * FRICTION * GRAVITY / speed**2
    commands = torch.zeros(first + 3 * SECOND, 3, 2)
    commands[..., 0] = speed
    commands[first:, :, 1] = speed * curvatures
    driven = Drive(backend, robot, commands)
    paths = driven.twist(ahead=rear)[:2]
    assert (paths[:, 1] / paths[:, 0]).tolist() == pytest.approx(curvatures[:2].tolist(), rel=0.1)
    assert driven.twist(ahead=center)[2, [0, 2]].norm() < 0.9 * speed
    assert driven.acceleration(2, ahead=center) < 1.1 * FRICTION * GRAVITY


def steepest(robot: Robot) -> float:
    """Slope up to which friction holds or drives a robot that faces up, degrees.

    A car's rear wheels carry ``N = m g (cos s b + sin s h) / L`` with the distance b of the center of mass from the
    front axle and its height h: ``mu N = m g sin s``.
    """
    if robot.drive.turns_in_place:
        return math.degrees(math.atan(FRICTION))
    x, _, height = robot.center_of_mass
    hubs = [hub[0] for hub in robot.wheels.hubs]
    return math.degrees(math.atan(FRICTION * (max(hubs) - x) / (max(hubs) - min(hubs) - FRICTION * height)))


@pytest.mark.parametrize("name", ["husky", "hunter"])
def test_climbs_and_stands_on_slopes_up_to_the_limit_of_friction(backend: str, name: str) -> None:
    robot = get_robot(name)
    limit, speed = steepest(robot), 0.5
    # Friction in Bullet is right in the mean over its steps, and weaker in some: close to the limit, rovers creep.
    below = 3.5 if backend == "bullet" else 1.0
    slopes = [limit - 1.5, limit + 1.5, limit - below, limit + 1.5]
    simulator = placed(backend, [slope(degrees) for degrees in slopes], torch.zeros(4, 3), robot)
    commands = torch.tensor([[speed, 0.0], [speed, 0.0], [0.0, 0.0], [0.0, 0.0]])
    x = torch.stack([simulator.step(commands).position[:, 0] for _ in range(3 * SECOND)])
    simulator.close()
    moved = x[-1] - x[-1 - SECOND]
    assert [moved[0] > 0.1 * speed, moved[1] < 0] == [True, True], moved
    assert [moved[2].abs() < 0.01, moved[3] < -0.01] == [True, True], moved


def test_a_fast_robot_feels_a_wall_and_stays_before_it(backend: str) -> None:
    """At 5 m/s, the racer drives 0.25 m in a step; the wall is 1 m thick."""
    simulator = placed(backend, WALLED, torch.tensor([[-6.5, 0.0, 0.0]]), get_robot("racer"))
    states = [simulator.step(torch.tensor([[5.0, 0.0]])) for _ in range(4 * SECOND)]
    simulator.close()
    x = torch.stack([state.position[0, 0] for state in states])
    assert x.diff().max() > 4.9 * DT
    assert any(state.contact is not None and bool(state.contact) for state in states)
    assert x.max() < 2.5


@needs_mujoco
@pytest.mark.parametrize("name", ["jackal", "racer"])
def test_the_simulators_agree_within_five_centimeters_after_five_seconds(name: str) -> None:
    """Commands are random, and held for a second."""
    robot, random = get_robot(name), torch.Generator().manual_seed(0)
    speed = min(1.0, robot.drive.max_speed) * (1.6 * torch.rand(5, 4, generator=random) - 0.6)
    turn = 2 * torch.rand(5, 4, generator=random) - 1
    skids = robot.drive.turns_in_place
    rate = (0.3 * robot.drive.max_yaw_rate if skids else 0.8 * speed / robot.drive.min_radius(robot.wheels)) * turn
    commands = torch.stack((speed, rate), -1).repeat_interleave(SECOND, 0)
    places = [Drive(backend, robot, commands).position[-1] for backend in ("bullet", "mujoco", "warp")]
    apart = [(one - other).norm(dim=-1).median() for one, other in combinations(places, 2)]
    assert max(apart) < 0.05, apart


def test_a_car_turns_about_the_center_of_its_geometry_and_not_in_place(backend, tmp_path):
    car = make_car(tmp_path)
    # The third one is sharper than it can turn, the last one in place.
    commands = torch.tensor([[0.8, 0.24], [-0.5, -0.5], [0.6, 0.9], [0.0, 2.0]])
    driven = Drive(backend, car, held(*commands.tolist()))
    forward, rate, _ = driven.twist(ahead=-WHEELBASE / 2)[:3].unbind(-1)
    within(forward, commands[:3, 0])
    within(rate / forward, [0.3, 1.0, 1 / car.drive.min_radius(car.wheels)])
    within(driven.last.linear_velocity[:3, 0], forward)
    within(driven.last.angular_velocity[:3, 0], rate)
    assert driven.position[:, 3].abs().max() < 0.01


def test_an_omnidirectional_robot_moves_in_every_direction(backend, tmp_path):
    omni = make_omni(tmp_path)
    commands = [(0.6, 0.0, 0.0), (0.0, 0.0, 0.5), (0.3, 0.0, -0.4), (0.0, 1.0, 0.0), (0.3, 0.5, 0.4)]
    driven = Drive(backend, omni, held(*commands, steps=2 * SECOND))
    within(driven.twist(), commands)
    state = driven.last
    within(torch.cat((state.linear_velocity, state.angular_velocity, state.lateral_velocity), -1), commands)
    if backend == "warp":
        # Commands may be without a sideways speed.
        within(Drive(backend, omni, held((0.5, 0.0))).twist(), [[0.5, 0.0, 0.0]])


def test_casters_carry_a_robot_and_do_not_hold_it(backend, tmp_path):
    commands = torch.tensor([[0.6, 0.0], [0.0, 1.0], [0.5, 0.8], [-0.4, 0.5]])
    driven = Drive(backend, make_pair(tmp_path), held(*commands.tolist()))
    within(driven.twist(), torch.cat((commands, torch.zeros(4, 1)), -1))
    within(driven.last.linear_velocity[:, 0], commands[:, 0])
    assert quaternion_to_euler(driven.last.orientation)[:, :2].abs().max() < 0.01


def test_a_rover_with_spheres_for_wheels_drives_and_turns(backend, edited):
    cylinder = '<cylinder radius="0.122" length="0.09"/></geometry>\n    </collision>'
    sphere = '<sphere radius="0.122"/></geometry>\n    </collision>'
    spheres = Robot.from_urdf(edited((cylinder, sphere), count=-1), drive=ROVER.drive)
    # The spheres reach 0.122 m to the sides of their hubs.
    assert spheres.footprint.half_width == pytest.approx(0.18 + 0.122)
    twist = Drive(backend, spheres, held((0.5, 0.0), (0.0, 1.0))).twist()
    within(twist[0, :1], [0.5])
    assert twist[1, 1] > 0.2


def test_no_drive_depends_on_its_company(backend, tmp_path):
    makes = ((make_car, (0.6, 0.4)), (make_omni, (0.3, 0.4, 0.2)), (make_pair, (0.5, 0.4)))
    for make, command in makes:
        robot, back = make(tmp_path), tuple(-x for x in command)
        alone = Drive(backend, robot, held(command, steps=8))
        among = Drive(backend, robot, held(back, command, command, steps=8))
        assert torch.equal(alone.position[:, 0], among.position[:, 1])
        assert torch.equal(alone.yaw[:, 0], among.yaw[:, 1])


def test_robots_of_the_family_any_reach_their_speed_and_turn_in_place_or_on_their_smallest_radius():
    robots = get_robots("any:0-31")
    count, cars = len(robots), torch.tensor([not robot.drive.turns_in_place for robot in robots])
    speeds = torch.tensor([robot.drive.max_speed for robot in robots])
    straight = [(speed, 0.0) for speed in speeds.tolist()]
    turning = [(0.0, 0.8) if robot.drive.turns_in_place else (0.3, 3.0) for robot in robots]
    driven = Drive("warp", Fleet(robots, torch.arange(count).repeat(2)), held(*straight, *turning, steps=70))
    assert driven.last.position[:, 2].abs().max() < 0.02
    speed, rate, _ = driven.twist().unbind(-1)
    assert ((speed[:count] / speeds - 1).abs() < 0.02).all()
    assert (rate[:count].abs() < 0.02).all()
    # A controller knows the slip of its wheels up to a tenth.
    assert ((rate[count:] / 0.8 - 1).abs()[~cars] < 0.2).all()
    radius = torch.tensor([robot.drive.min_radius(robot.wheels) for robot in robots])
    assert ((0.3 / rate[count:] / radius - 1).abs()[cars] < 0.05).all()
