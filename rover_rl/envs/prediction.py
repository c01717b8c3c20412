"""``Prediction``: what late sensors tell, carried on to now by the commands that have been sent since."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.envs.stages import CommandDelay, DelayLine, SensorDelays, Stage, StepState
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.turning import yaw_gain
from rover_rl.rotations import wrap_angle
from rover_rl.sims.rover_state import SimulatedDrives


class Prediction(Stage):
    """Carries late poses and velocities on to now, by the commands sent since.

    It is a Smith predictor (O. J. M. Smith, "Closer control of loops with dead time", Chemical Engineering Progress 53,
    1957): a model of the drive follows the commands without delay. What the sensors tell of the time ``t - d``, and
    what the model has done since, give the state at the time ``t``. The model may be off in its place, as only its
    motion since counts. In a step of ``dt``, with the command ``c`` that the drive receives, it does

        s' = advance(s, c)                      set point, within the acceleration of the drive
        (v, w, l) = odometry(targets(s, s'))    speed, yaw rate and speed to the left of the wheels
        h' = h + g w dt                         heading: the body turns at g times the rate of wheels that slip
        p' = p + R((h + h') / 2) (v, l - k g w) dt

    with the rotation ``R``, for a base that turns about points on a line ``k`` ahead of its middle. With the
    composition of poses in the plane, ``P = (p, h)``, and velocities ``V = (v, w)``, the predicted ones are

        P(t) = sensed P(t - d) o (model P(t - d)^-1 o model P(t))
        V(t) = sensed V(t - d) + model V(t) - model V(t - d)

    On a slope, the way is that of the pitch at the time ``t - d``.

    ``most`` is the longest delay of the sensors, steps; the robot knows how old their messages are. ``latency`` is the
    range of the delay of commands, steps, in whose middle the robot takes its own to be. A ``live`` rover limits its
    commands itself, and its stamps tell ages.
    """

    def __init__(
        self, fleet: Fleet, dt: float, most: int, latency: tuple[int, int], delays: SensorDelays, live: Any = None
    ) -> None:
        self._fleet, self._most, self._delays, self._live = fleet, most, delays, live
        usual, device = round(sum(latency) / 2), fleet.index.device
        self._latency = CommandDelay((usual, usual), len(fleet), device)
        self._drives, self._line = SimulatedDrives(fleet, dt), DelayLine(most)
        # Gain of the yaw rate, and x of the line on which the centers of turns lie.
        self._turning = fleet.table(lambda robot: [yaw_gain(robot), robot.drive.pivot(robot.wheels)])
        # Position and heading of the model since the start of the episode, and its speed and yaw rate.
        self._model = torch.zeros(len(fleet), 5, device=device)
        # The last command, and the number of steps before it.
        self._sent: tuple[Tensor, Tensor] | None = None

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        self._latency.begin(mask, keys)
        self._drives.reset(mask.squeeze(-1))
        self._model = self._model.masked_fill(mask, 0.0)
        self._sent = None

    def command(self, command: Tensor, state: StepState) -> Tensor:
        self._sent = command, state.steps
        return command

    def read(self, state: StepState) -> None:
        if self._sent is not None:
            self._follow(*self._sent, state.sensed.rover.dt, state.active)
        rover, steps, delays = state.sensed.rover, state.steps, self._delays
        delay, velocities = delays.state, torch.cat((rover.linear_velocity, rover.angular_velocity), -1)
        velocities = delays.late("velocities", velocities, steps, delay)
        if self._live is not None:
            delay = delay + self._live.state_age().to(velocities) / rover.dt
        known, velocities = self._predicted(delays.known, velocities, steps, delay)
        delays.tell(known, state)
        state.predicted = {"pose": known[:, :3], "imu": known[:, 3:], "velocities": velocities}

    def _follow(self, command: Tensor, steps: Tensor, dt: Tensor, active: Tensor | None) -> None:
        if self._live is not None:
            command = command.new_tensor([self._live.last_command])
        received = self._latency.delayed(command, steps)
        joints = self._drives.advance(received, None if active is None else active.squeeze(-1))
        twist = self._drives.odometry(joints)
        ahead, rate, left = pad(twist, (0, 3 - twist.shape[-1])).split(1, -1)
        gain, pivot = self._turning[self._fleet.index].split(1, -1)
        turn = gain * rate * dt
        position, heading, _ = self._model.split((2, 1, 2), -1)
        way = _turned(torch.cat((ahead * dt, left * dt - pivot * turn), -1), heading + turn / 2)
        moved = torch.cat((position + way, heading + turn, ahead, rate), -1)
        self._model = moved if active is None else torch.where(active, moved, self._model)

    def _predicted(self, known: Tensor, velocities: Tensor, steps: Tensor, delay: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the present pose ``[N, 6]`` and velocities ``[N, 2]`` for those of ``delay`` steps ago."""
        delay = delay.clamp(max=self._most)
        then = self._line("model", self._model, steps, delay.long())
        if delay.is_floating_point():
            before = self._line("model", self._model, steps, delay.ceil().long())
            then = torch.lerp(then, before, delay.frac())
        place, pitch, roll, yaw = known.split((3, 1, 1, 1), -1)
        since = self._model - then
        ahead, left = _turned(since[:, :2], -then[:, 2:3]).split(1, -1)
        way = _turned(torch.cat((ahead * pitch.cos(), left), -1), yaw)
        moved = place + torch.cat((way, -ahead * pitch.sin()), -1)
        return torch.cat((moved, pitch, roll, wrap_angle(yaw + since[:, 2:3])), -1), velocities + since[:, 3:]


def _turned(vectors: Tensor, angle: Tensor) -> Tensor:
    (x, y), cos, sin = vectors.split(1, -1), angle.cos(), angle.sin()
    return torch.cat((cos * x - sin * y, sin * x + cos * y), -1)
