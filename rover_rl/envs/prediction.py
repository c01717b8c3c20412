"""``Prediction``: what late sensors tell, carried on to now by the commands that have been sent since.

It is a Smith predictor (O. J. M. Smith, "Closer control of loops with dead time", Chemical Engineering Progress 53,
1957): a model of the drive follows the commands without delay. What the sensors tell of the time ``t - d``, and what
the model has done since, give the state at the time ``t``. The model may be off in its place, as only its motion since
counts. In a step of ``dt``, with the command ``c`` that the drive receives, it does

    s' = advance(s, c)                      set point, within the acceleration of the drive
    (v, w, l) = odometry(targets(s, s'))    speed, yaw rate and speed to the left of the wheels
    h' = h + g w dt                         heading: the body turns at g times the rate of wheels that slip
    p' = p + R((h + h') / 2) (v, l - k g w) dt

with the rotation ``R``, for a base that turns about points on a line ``k`` ahead of its middle. With the composition of
poses in the plane, ``P = (p, h)``, and velocities ``V = (v, w)``, the predicted ones are

    P(t) = sensed P(t - d) o (model P(t - d)^-1 o model P(t))
    V(t) = sensed V(t - d) + model V(t) - model V(t - d)

On a slope, the way is that of the pitch at the time ``t - d``.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from rover_rl.envs.delays import CommandDelay, DelayLine
from rover_rl.robots.fleet import Fleet
from rover_rl.robots.skidding import yaw_gain
from rover_rl.rotations import wrap_angle
from rover_rl.sims.simulated_drives import SimulatedDrives


class Prediction:
    """Predicts the present state of a batch of rovers from a late one.

    Args:
        fleet: robots of the rows.
        dt: duration of a control step, s.
        most: longest delay of the sensors, steps. The robot knows how old their messages are.
        latency: range of the delay of commands, steps, in whose middle the robot takes its own to be.
    """

    def __init__(self, fleet: Fleet, dt: float, most: int, latency: tuple[int, int]) -> None:
        self._fleet, self._most, device = fleet, most, fleet.index.device
        usual = round(sum(latency) / 2)
        self._latency = CommandDelay((usual, usual), len(fleet), device)
        self._drives, self._line = SimulatedDrives(fleet, dt), DelayLine(most)
        # Gain of the yaw rate, and x of the line on which the centers of turns lie.
        self._turning = fleet.table(lambda robot: [yaw_gain(robot), robot.drive.pivot(robot.wheels)])
        # Position and heading of the model since the start of the episode, and its speed and yaw rate.
        self._model = torch.zeros(len(fleet), 5, device=device)

    def begin(self, mask: Tensor, keys: Tensor) -> None:
        """Begins episodes, at rest, in the rows of ``mask`` (bool ``[N, 1]``). ``keys`` are the random keys of all."""
        self._latency.begin(keys)
        self._drives.reset(mask.squeeze(-1))
        self._model = self._model.masked_fill(mask, 0.0)

    def follow(self, command: Tensor, steps: Tensor, dt: Tensor, active: Tensor | None) -> None:
        """Moves the model by a step.

        Args:
            command: forward speed (m/s), yaw rate (rad/s) and further components that are sent, ``[N, A]``.
            steps: number of steps of each row's episode before this one, int64 ``[N, 1]``.
            dt: duration of the step, ``[N, 1]``, s.
            active: rows that take it, bool ``[N, 1]``. ``None``: all.
        """
        received = self._latency(command, steps)
        joints = self._drives.advance(received, None if active is None else active.squeeze(-1))
        twist = self._drives.odometry(joints)
        ahead, rate, left = pad(twist, (0, 3 - twist.shape[-1])).split(1, -1)
        gain, pivot = self._turning[self._fleet.index].split(1, -1)
        turn = gain * rate * dt
        position, heading, _ = self._model.split((2, 1, 2), -1)
        way = _turned(torch.cat((ahead * dt, left * dt - pivot * turn), -1), heading + turn / 2)
        moved = torch.cat((position + way, heading + turn, ahead, rate), -1)
        self._model = moved if active is None else torch.where(active, moved, self._model)

    def __call__(self, known: Tensor, velocities: Tensor, steps: Tensor, delay: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the present pose ``[N, 6]`` and velocities ``[N, 2]``.

        Args:
            known: late pose: x, y and z (m), pitch, roll and yaw (rad), ``[N, 6]``. Pitch and roll stay.
            velocities: late speed (m/s) and yaw rate (rad/s) of the wheels, ``[N, 2]``.
            steps: number of steps of each row's episode, int64 ``[N, 1]``.
            delay: how late pose and velocities are, steps, int64, or float32 of a live rover, ``[N, 1]``.
        """
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
    """Returns vectors ``[N, 2]`` turned by angles ``[N, 1]``, rad."""
    (x, y), cos, sin = vectors.split(1, -1), angle.cos(), angle.sin()
    return torch.cat((cos * x - sin * y, sin * x + cos * y), -1)
