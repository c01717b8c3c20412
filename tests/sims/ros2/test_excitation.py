"""The drive that tells the numbers of a robot: it tells them, stays around its start, and stops."""

from __future__ import annotations

import cmath
import math
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from rover_rl import Terrain, World, box
from rover_rl.algos.calibration.calibrate import calibrate
from rover_rl.algos.calibration.reading import read_recording
from rover_rl.algos.deploy import bags, excitation
from rover_rl.algos.deploy.excitation import Excitation
from rover_rl.algos.deploy.recorded_drives import read_drives
from rover_rl.cli.main import main
from rover_rl.cli.train import INTERRUPTED
from rover_rl.robots import get_robot
from rover_rl.sims.ros2 import messages as ros
from rover_rl.sims.ros2.settings import Ros2Settings
from rover_rl.sims.settings import Connection
from tests.algos.calibration.drives import Truth, drive, write
from tests.sims.ros2.wire import SimulatedRobot, Wire

OPEN = World("open", Terrain.flat((30, 30)), obstacles=[box((-6, 3, 0.5), (1, 8, 1)), box((7, -2, 0.5), (1, 5, 1))])
RADIUS = 1.5


@pytest.fixture(autouse=True)
def _recorded_in_time_of_the_wire(wire: Wire, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bags, "time", SimpleNamespace(time_ns=lambda: round(1e9 * wire.now)))
    monkeypatch.setattr(bags, "WAITING", 10**6)


def excite(bag: Path, *options: str) -> int:
    return main(["drive", "--excite", "--radius", str(RADIUS), "--bag", str(bag), *options])


def excited(name: str, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Lets a kinematic robot drive it: commands at 20 Hz, ``[K, 3]`` (s, m/s and rad/s), and places, ``[K, 2]``."""
    robot, dt, rows, places = get_robot(name), 0.05, [], []
    base = robot.drive
    narrowest = base.min_radius(robot.wheels)
    driver = Excitation(radius, Ros2Settings())
    driver.enter(SimpleNamespace(robot=robot, rover_state=SimpleNamespace(dt=torch.tensor([[dt]]))))
    place, yaw, speed, turn, angle = 0j, 1.0, 0.0, 0.0, 0.0
    for step in range(round(driver.seconds / dt)):
        home = -place * cmath.exp(-1j * yaw)
        now = {"target": [[abs(home), cmath.phase(home)]], "velocities": [[speed, turn]]}
        entries = {name: torch.tensor(value) for name, value in now.items()}
        steps = TensorDict({"steps": torch.tensor([[step]])}, [1])
        v, w = driver(TensorDict({**entries, "outcome": steps}, [1]))["action"][0].tolist()
        most = base.max_linear_acceleration * dt
        speed += max(-most, min(v - speed, most))
        if narrowest:
            length, most = base.wheelbase(robot.wheels), base.max_steering_rate * dt
            angle += max(-most, min((math.atan(length * w / v) if v else angle) - angle, most))
            turn = speed * math.tan(angle) / length
        else:
            turn = w
        yaw += turn * dt
        place += speed * dt * cmath.exp(1j * yaw)
        rows.append((step * dt, v, w))
        places.append((place.real, place.imag))
    return np.array(rows), np.array(places)


@pytest.mark.parametrize(("name", "radius"), [("rover_zero", 1.5), ("jackal", 2.0), ("hunter", 2.0), ("racer", 1.6)])
def test_it_turns_as_the_robot_can_and_stays_around_its_start(name, radius):
    robot = get_robot(name)
    commands, places = excited(name, radius)
    time, v, w = commands.T
    assert np.hypot(*places.T).max() < radius + 0.1
    assert time[-1] < 240
    assert (v[-1], w[-1]) == (0.0, 0.0)
    narrowest = robot.drive.min_radius(robot.wheels)
    assert ((v == 0) & (w != 0)).any() == robot.drive.turns_in_place
    for direction in (-1, 1):
        ahead = direction * v > 0
        assert (abs(w[ahead]) * narrowest <= abs(v[ahead])).all()
        if narrowest:
            assert {-1, 1} <= {*np.sign(w[ahead])}, "bows to both sides"
            assert (abs(w[ahead]) * narrowest / abs(v[ahead])).max() > 0.8, "narrow ones"


def test_the_turning_circle_of_a_car_needs_room():
    with pytest.raises(ValueError, match=r"turns in 0\.91 m at least needs a --radius of 1\.82 m or more, got 1\.5"):
        excited("hunter", 1.5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "untold"), [("rover_zero", set()), ("hunter", {"scan_late", "turn_top", "slip", "track"})]
)
def test_it_tells_all_numbers_but_friction(tmp_path, name, untold):
    bag = write(tmp_path / "bag", drive(Truth(yaw_bias=0.003), excited(name, 2.0)[0]))
    numbers = calibrate(read_recording(bag, Connection(), Ros2Settings()), get_robot(name)).numbers
    assert {name for name, number in numbers.items() if number.estimate is None} <= {"friction", *untold}
    true = {"speed_top": 0.9, "turn_top": 1.5, "speed_acceleration": 1.2, "turn_acceleration": 3.0, "speed_lag": 0.15}
    for name, value in true.items():
        assert name in untold or numbers[name].estimate.value == pytest.approx(value, rel=0.05), name
    assert numbers["command_delay"].estimate.value == pytest.approx(0.12, abs=0.02)


@pytest.mark.slow
def test_a_simulated_car_drives_it_to_its_end(wire, tmp_path, capsys, monkeypatch):
    for name, short in {"REST": 0.5, "PAUSE": 0.5, "CHIRP": 2.0, "SHARES": (1.0,), "ARCS": ()}.items():
        monkeypatch.setattr(excitation, name, short)
    robot = SimulatedRobot(wire, OPEN, (0.5, 0.3, 1.0), robot="hunter")
    assert excite(tmp_path / "drive.mcap", "--robot", "hunter", "--radius", "2") == 0
    assert "excite: complete" in capsys.readouterr().out
    assert wire.sent["/cmd_vel"][-3:] == [ros.Twist()] * 3
    places = torch.stack([place[:2] for place, _ in robot.poses.values()])
    gone = (places - torch.tensor([0.5, 0.3])).norm(dim=-1).max()
    assert 0.8 < gone < 2.1
    robot.rover.close()


def near(scan: ros.LaserScan) -> ros.LaserScan:
    ranges = scan.ranges.copy()
    ranges[0] = 0.4
    return replace(scan, ranges=ranges)


def interrupt(scan: ros.LaserScan) -> ros.LaserScan:
    signal.raise_signal(signal.SIGINT)
    return scan


@pytest.mark.parametrize(
    ("event", "code", "ending"), [(near, 1, "obstacle too near"), (interrupt, INTERRUPTED, "stopped")]
)
def test_it_stops_at_what_is_too_near_and_when_it_is_interrupted(wire, tmp_path, event, code, ending):
    robot = SimulatedRobot(wire, OPEN, (0.0, 0.0, 0.0))
    wire.tamper["/scan"] = lambda scan: event(scan) if max(robot.driven, default=0.0) > 0.1 else scan
    assert excite(tmp_path / "drive.mcap") == code
    assert wire.sent["/cmd_vel"][-3:] == [ros.Twist()] * 3
    assert [drive.ending for drive in read_drives(tmp_path / "drive.mcap").drives] == [ending]
    robot.rover.close()
