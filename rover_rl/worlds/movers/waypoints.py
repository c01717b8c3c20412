"""``Waypoints``: a path that is given by keyframes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeAlias, get_args

import torch
from torch import Tensor

from rover_rl.checks import check_at_least, check_positive
from rover_rl.rng import to_unit
from rover_rl.rotations import wrap_angle
from rover_rl.worlds.movers.motion import Motion, MotionInput, MoverState

Keyframe: TypeAlias = tuple[float, float, float, float]
Point: TypeAlias = tuple[float, float]
Repeat: TypeAlias = Literal["once", "loop", "back_and_forth"]
MAX_SPEED = 10.0
"""Largest speed of a mover, m/s."""
MAX_TIME = 1e6
"""Largest duration among the settings, s."""
_DOOR_STEP = math.radians(3)
"""Angle of a door between two keyframes: the middle of the leaf is off its circle by 0.03 % of the width at most."""


@dataclass(frozen=True)
class Waypoints(Motion):
    """A path from keyframe to keyframe, at constant speed between two of them.

    The position at a time depends on nothing else, unless ``random_start`` is set. Before the first keyframe and after
    the last one of ``"once"``, the mover rests.

    Args:
        keys: keyframes: time (s), x, y (m) and yaw (rad). Times start at 0 or later, in ascending order; two at the
            same time are a jump. The yaw takes the shortest way to that of the next keyframe.
        repeat: ``"once"``, ``"loop"`` (begins again at the first keyframe, at once) or ``"back_and_forth"``.
        delay: time before the first keyframe's time 0, s.
        random_start: whether each episode starts at a random time of the path.

    Raises:
        ValueError: if there is no keyframe, a number is not finite, or the times are not in order.
    """

    keys: Sequence[Keyframe]
    repeat: Repeat = "loop"
    delay: float = 0.0
    random_start: bool = False

    def __post_init__(self) -> None:
        keys = tuple(tuple(float(number) for number in key) for key in self.keys)
        object.__setattr__(self, "keys", keys)
        if not keys or any(len(key) != 4 or not all(map(math.isfinite, key)) for key in keys):
            raise ValueError(f"keyframes must be finite (time, x, y, yaw), at least one, got {self.keys}")
        times = [key[0] for key in keys]
        if times[0] < 0 or any(b < a for a, b in pairwise(times)):
            raise ValueError(f"the times of keyframes must be at least 0 and in ascending order, got {times}")
        if self.repeat not in get_args(Repeat):
            raise ValueError(f"repeat must be one of {get_args(Repeat)}, got {self.repeat!r}")
        if self.repeat == "loop" and len(keys) > 1 and times[-1] <= 0:
            raise ValueError(f"the period of a loop must be positive, got {times[-1]}")
        if not (math.isfinite(self.delay) and self.delay >= 0):
            raise ValueError(f"delay must be at least 0, got {self.delay}")

    @classmethod
    def there_and_back(
        cls,
        start: Point,
        to: Point,
        speed: float = 1.0,
        pause: float = 0.0,
        yaw: float | None = None,
        random_start: bool = False,
    ) -> Waypoints:
        """Slides back and forth between two points (m), as a gate or a cart does, and never turns.

        It rests at each end for ``pause`` (s). Its heading is ``yaw`` (rad), or the direction from ``start`` to ``to``.
        """
        check_positive(MAX_SPEED, speed=speed)
        check_at_least(0.0, MAX_TIME, pause=pause)
        if start == to:
            raise ValueError(f"start and to must be different points, got {to} twice")
        yaw = math.atan2(to[1] - start[1], to[0] - start[0]) if yaw is None else yaw
        way = math.dist(start, to) / speed
        ends = [(0.0, start), (way, to), (way + pause, to), (2 * way + pause, start), (2 * (way + pause), start)]
        return cls([(time, *point, yaw) for time, point in ends], random_start=random_start)

    @classmethod
    def door(
        cls,
        hinge: Point,
        width: float = 0.9,
        closed: float = 0.0,
        opening: float = math.pi / 2,
        period: float = 8.0,
        pause: float = 0.0,
        random_start: bool = False,
    ) -> Waypoints:
        """Swings open about a hinge and shut again. The shape of the leaf is ``Box(width, 0.05, 2.0)``.

        Args:
            hinge: point of the hinge, m. The heading points from it to the other edge.
            width: width of the leaf, m.
            closed: heading of the shut leaf, rad.
            opening: angle by which it opens, counter-clockwise if positive, rad.
            period: time of opening and shutting with both pauses, s.
            pause: rest when open, and when shut, s.
        """
        check_positive(MAX_TIME, width=width, period=period)
        if period <= 2 * pause:
            raise ValueError(f"period must be longer than two pauses of {pause:g} s, got {period}")
        steps = max(1, math.ceil(abs(opening) / _DOOR_STEP))
        swing = [step / steps for step in range(steps + 1)]
        shares = [(share * (period / 2 - pause), share) for share in swing]
        shares += [(period / 2 + time, 1 - share) for time, share in shares] + [(period, 0.0)]
        x, y, arm = *hinge, width / 2
        yaws = [(time, closed + share * opening) for time, share in shares]
        keys = [(time, x + arm * math.cos(yaw), y + arm * math.sin(yaw), yaw) for time, yaw in yaws]
        return cls(keys, random_start=random_start)

    def first_point(self) -> Point | None:
        return None if self.random_start else self.keys[0][1:3]

    def tensors(self) -> dict[str, Tensor]:
        """Returns the legs from the keyframes on, ``[K, 8]``, and what else the position depends on.

        A leg has the time, x, y and yaw of its keyframe, its duration, and the rates of x, y and yaw.
        """
        keys = torch.tensor(self.keys, dtype=torch.float64)
        change = keys.diff(dim=0, append=keys[-1:])
        change[:, 3] = wrap_angle(change[:, 3])
        span = change[:, :1]
        numbers = {"period": self.keys[-1][0], "repeat": get_args(Repeat).index(self.repeat), "delay": self.delay}
        numbers["random_start"] = self.random_start
        return {
            "keys": torch.cat((keys, span, change[:, 1:] / span.clamp(min=1e-9)), 1),
            "count": torch.tensor(len(keys)),
            **{name: torch.tensor(number, dtype=torch.float64) for name, number in numbers.items()},
        }

    @classmethod
    def begin(cls, inputs: MotionInput) -> MoverState:
        """Starts at time 0, or at a random time, which the clock keeps."""
        settings = inputs.settings
        cycle = torch.where(settings["repeat"] == 2, 2 * settings["period"], settings["period"])
        offset = settings["random_start"] * cycle * to_unit(inputs.bits(1)[..., 0])
        # In the precision in which the clock is stored.
        return cls._at(inputs, offset.float())

    @classmethod
    def advance(cls, inputs: MotionInput) -> MoverState:
        return cls._at(inputs, inputs.state.clock)

    @classmethod
    def _at(cls, inputs: MotionInput, offset: Tensor) -> MoverState:
        settings, state = inputs.settings, inputs.state
        keys, whole = settings["keys"], settings["period"].clamp(min=1e-6)
        time = (inputs.time + offset - settings["delay"]).clamp(min=0)
        folded = torch.remainder(time, 2 * whole)
        looped = torch.where(folded < whole, folded, folded - whole)
        back_and_forth = torch.minimum(folded, 2 * whole - folded)
        repeated = torch.where(settings["repeat"] == 1, looped, back_and_forth)
        time = torch.where(settings["repeat"] == 0, time, repeated)
        # The leg of the last keyframe that is not later.
        numbers = torch.arange(keys.shape[-2], device=keys.device)
        passed = (keys[..., 0] <= time[..., None]) & (numbers < settings["count"][..., None])
        last = (passed.sum(-1) - 1).clamp(min=0)
        # Rows of a matrix are selected much faster than gathered.
        first = torch.arange(last.numel(), device=keys.device).reshape(last.shape) * keys.shape[-2]
        leg = keys.flatten(0, -2)[first + last]
        begin, span, way = leg[..., 0], leg[..., 4], leg[..., 5:7]
        passed_time = torch.minimum((time - begin).clamp(min=0), span)
        position = leg[..., 1:3] + passed_time[..., None] * way
        # Backward on the way back, and at rest at the ends.
        returns = (settings["repeat"] == 2) & (folded > whole)
        heading = torch.where(returns, -1.0, 1.0)[..., None] * ((passed_time > 0) & (passed_time < span))[..., None]
        yaw = leg[..., 3] + passed_time * leg[..., 7]
        return replace(state, position=position, yaw=yaw, velocity=way * heading, clock=offset)
