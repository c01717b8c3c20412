"""What is measured of driving: each metric once, as a function of recorded trajectories, with a 95 % interval.

Names in brackets are the original's, which has no formula for MTT and TR and never logs VORT. Episodes are the unit
that varies: shares of episodes carry Wilson's interval, everything else is a ratio of sums over episodes and carries a
percentile bootstrap over them. An interval says nothing of how much training varies: for that, train several seeds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from rover_rl.algos.config import SECONDS_PER_STEP
from rover_rl.sims.robots import Robot, get_robot
from rover_rl.sims.rotations import wrap_angle
from rover_rl.sims.worlds import World
from rover_rl.sims.worlds.free_space import distance_to_polygon
from rover_rl.sims.worlds.obstacles import Obstacle

ROUGH_TILT = math.radians(10)
"""Ground on which the rover leans this much or more, in any direction, is rough: most of inspect, a tenth of the moon,
and nothing of the maze. The original's own mark, an acceleration beyond 15 m/s^2, is not met by a rover on wheels at
1 m/s: in the 20 Hz positions of 192 episodes in the three worlds the most was 10 m/s^2."""
STANDSTILL = 0.05
"""Slower than this is standing, m/s."""
TOUCH = 0.01
"""A body that comes as near as this to an obstacle touches it, m."""
Z = 1.96
"""Standard deviations of a normal distribution on either side that hold 95 % of it."""
RESAMPLES = 2000
_OUTLINE_SPACING = 0.02
_CHUNK = 4096
"""Poses whose outlines are held against an obstacle at once; bounds the memory to some 100 MB."""

TIME_LIMIT = "time limit"
TOO_NEAR = "obstacle too near"
"""An ending of drives with a live rover: something came nearer than was allowed."""
STOPPED = "stopped"
"""Another: a person ended it, or the rover was lost."""
RESTARTED = "robot restarted"
"""Another: the rover's clock went back, or its pose jumped."""
EARLY_ENDINGS = ("flipped", "jammed", "out of bounds", "stuck", "invalid action", TOO_NEAR, RESTARTED, STOPPED)
"""How an episode can end before its time, other than at its goal."""


@dataclass(frozen=True)
class Metric:
    """How a metric is shown.

    Attributes:
        heading: of its column.
        meaning: in a few words; a way to end an episode speaks for itself.
        unit: ``"%"`` for shares, which are numbers up to 1, ``"s"``, ``"m/s"``, ``"1/s"``, or none.
    """

    heading: str
    meaning: str = ""
    unit: str = ""


METRICS = {
    "success_rate": Metric("SR", "episodes that reached their goal", "%"),
    "spl": Metric("SPL", "success weighted by path length"),
    "mean_time_to_traverse": Metric("MTT", "time to a goal that was reached", "s"),
    "traverse_rate": Metric("TR", "shortest path covered a second", "m/s"),
    "goals_per_episode": Metric("goals", "reached an episode"),
    "seconds_per_goal": Metric("time", "of driving a goal", "s"),
    "episode_seconds": Metric("episode", "mean duration", "s"),
    "ended_early": Metric("early", "episodes that ended before their time", "%"),
    "velocity_over_rough_terrain": Metric("VORT", "speed on ground of 10 degrees or more", "m/s"),
    "collisions": Metric("TC", "collisions an episode"),
    "body_contacts": Metric("touches", "contacts of the body with obstacles an episode"),
    "body_contact_share": Metric("touched", "episodes with such a contact", "%"),
    "turns_per_goal": Metric("turns", "full turns a goal"),
    "standstill": Metric("still", "time spent slower than 0.05 m/s", "%"),
    "command_reversals": Metric("reversals", "changes of the commanded turning direction a second", "1/s"),
    **{f"ending_{kind.replace(' ', '_')}": Metric(kind, unit="%") for kind in (TIME_LIMIT, *EARLY_ENDINGS)},
}
"""All metrics by name, in the order in which they are shown."""


@dataclass(frozen=True)
class Estimate:
    """A measured value, and where the true one lies with 95 % confidence; nan where there is nothing to measure."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Trajectory:
    """What was recorded of an episode of T steps at 20 Hz.

    Attributes:
        position: of the rover, at the start and after each step, float32 ``[T + 1, 3]``, m.
        angles: its roll, pitch and yaw, ``[T + 1, 3]``, rad.
        collision: which steps ended in collision: a lidar reading below 0.3 m, bool ``[T]``.
        goal: which steps reached a goal, bool ``[T]``.
        ending: how it ended: ``"goal"``, :data:`TIME_LIMIT`, or one of :data:`EARLY_ENDINGS`.
        reversals: changes of the commanded turning direction; nan where commands were not recorded.
    """

    position: Tensor
    angles: Tensor
    collision: Tensor
    goal: Tensor
    ending: str
    reversals: float = math.nan

    def __len__(self) -> int:
        return len(self.collision)

    @property
    def seconds(self) -> float:
        """It lasted."""
        return len(self) * SECONDS_PER_STEP

    @property
    def path(self) -> Tensor:
        """Where the rover was, seen from above: ``[T + 1, 2]``, m."""
        return self.position[:, :2]

    @property
    def length(self) -> float:
        """Of the path, seen from above, m."""
        return self.path.double().diff(dim=0).norm(dim=1).sum().item()

    @cached_property
    def speed(self) -> Tensor:
        """Mean speed over ground in each step, ``[T]``, m/s: of the body, not of the wheels."""
        return self.position.diff(dim=0).norm(dim=1) / SECONDS_PER_STEP

    @property
    def tilt(self) -> Tensor:
        """Angle between the rover's up and the world's after each step, ``[T]``, rad."""
        roll, pitch, _ = self.angles[1:].unbind(-1)
        return torch.arccos((roll.cos() * pitch.cos()).clamp(-1, 1))

    @property
    def turns(self) -> float:
        """Full turns: all changes of heading, left and right alike, over 2 pi."""
        return wrap_angle(self.angles[:, 2].double().diff()).abs().sum().item() / (2 * math.pi)


def proportion(successes: int, count: int) -> Estimate:
    """A share with Wilson's score interval (Wilson, "Probable inference", J. Am. Stat. Assoc. 22, 1927).

    Example:
        >>> proportion(5, 10)
        Estimate(value=0.5, low=0.2365..., high=0.7634...)
    """
    if not count:
        return Estimate(math.nan, math.nan, math.nan)
    share, spread = successes / count, Z**2 / count
    centre = share + spread / 2
    margin = Z * math.sqrt((share * (1 - share) + spread / 4) / count)
    return Estimate(share, max(0.0, (centre - margin) / (1 + spread)), min(1.0, (centre + margin) / (1 + spread)))


def ratio(numerators: Sequence[float], denominators: Sequence[float] | None = None) -> Estimate:
    """``sum(numerators) / sum(denominators)`` over episodes with a percentile bootstrap over them.

    Without ``denominators`` it is the mean. Always the same 2,000 resamples are taken for a number of episodes (Efron,
    "Bootstrap methods", Ann. Stat. 7, 1979). Where all episodes are alike the interval has no width; where only one of
    them has a denominator above 0, there is no telling, and its ends are nan.
    """
    top = torch.tensor(numerators, dtype=torch.float64)
    bottom = torch.ones_like(top) if denominators is None else torch.tensor(denominators, dtype=torch.float64)
    counted = int((bottom > 0).sum())
    value = (top.sum() / bottom.sum()).item() if counted else math.nan
    if counted < 2:
        return Estimate(value, math.nan, math.nan)
    drawn = torch.randint(len(top), (RESAMPLES, len(top)), generator=torch.Generator().manual_seed(0))
    resampled = top[drawn].sum(1) / bottom[drawn].sum(1)
    # A resample of nothing over nothing says nothing; between two infinities there would be no number.
    ends = torch.tensor((0.025, 0.975), dtype=torch.float64)
    low, high = torch.nanquantile(resampled, ends, interpolation="nearest").tolist()
    return Estimate(value, low, high)


def success_rate(trajectories: Sequence[Trajectory]) -> Estimate:
    """[SR] Share of episodes that reached their goal in time; an early ending is a failure."""
    return ending_share(trajectories, "goal")


def ending_share(trajectories: Sequence[Trajectory], *endings: str) -> Estimate:
    """Share of episodes that ended in one of these ways."""
    return proportion(sum(t.ending in endings for t in trajectories), len(trajectories))


def spl(trajectories: Sequence[Trajectory], shortest: Tensor) -> Estimate:
    """Success weighted by path length: mean of ``S l / max(p, l)``, between 0 and 1.

    ``S`` is 1 for a success and 0 otherwise, ``p`` the length driven and ``l`` the shortest, both seen from above
    (Anderson et al., "On Evaluation of Embodied Navigation Agents", 2018, arXiv:1807.06757).

    Args:
        trajectories: an episode each.
        shortest: length of the shortest paths, ``[count]``, m.
    """
    pairs = zip(trajectories, shortest.tolist(), strict=True)
    return ratio([(t.ending == "goal") * least / max(t.length, least, 1e-9) for t, least in pairs])


def mean_time_to_traverse(trajectories: Sequence[Trajectory]) -> Estimate:
    """[MTT] Mean seconds to the goal of the episodes that reached it.

    Read it beside the success rate: a policy that reaches only near goals is quick.
    """
    reached = [t.ending == "goal" for t in trajectories]
    return ratio([t.seconds * r for t, r in zip(trajectories, reached, strict=True)], reached)


def traverse_rate(trajectories: Sequence[Trajectory], shortest: Tensor) -> Estimate:
    """[TR] Metres of shortest path that were covered for each second of driving: ``sum(S l) / sum(t)``, in m/s.

    The original names it and gives no formula. Here it is the rate at which a rover delivers what it was sent for, so
    that failures count with all their time ``t`` and none of their way: what progress towards a goal is worth that was
    not reached, nobody can say, and SPL credits none either. Its bound is the speed limit of 1 m/s.
    """
    pairs = zip(trajectories, shortest.tolist(), strict=True)
    return ratio([(t.ending == "goal") * least for t, least in pairs], [t.seconds for t in trajectories])


def velocity_over_rough_terrain(trajectories: Sequence[Trajectory]) -> Estimate:
    """[VORT] Mean speed over ground in m/s of the steps on rough ground, where the tilt is 10 degrees or more.

    The original means ground that shakes the rover (see :data:`ROUGH_TILT`), and never logs it. nan without such
    ground, as in the maze.
    """
    rough = [t.tilt >= ROUGH_TILT for t in trajectories]
    return ratio(
        [t.speed[r].sum().item() for t, r in zip(trajectories, rough, strict=True)], [r.sum().item() for r in rough]
    )


def collisions(trajectories: Sequence[Trajectory]) -> Estimate:
    """[TC] Collisions an episode: runs of steps with a lidar reading below 0.3 m, each run counted once."""
    return ratio([count_runs(t.collision) for t in trajectories])


def standstill(trajectories: Sequence[Trajectory]) -> Estimate:
    """Share of the time in which the rover moves less than 0.05 m/s over ground."""
    slow = [(t.speed < STANDSTILL).sum().item() for t in trajectories]
    return ratio(slow, [len(t) for t in trajectories])


def command_reversals(trajectories: Sequence[Trajectory]) -> Estimate:
    """Changes of the commanded turning direction for each second of driving; nan unless commands were recorded.

    A rover that follows its heading calmly has about one; a controller that oscillates has up to 20 at 20 Hz.
    """
    return ratio([t.reversals for t in trajectories], [t.seconds for t in trajectories])


def count_reversals(yaw_rates: Sequence[float]) -> int:
    """How often the sign of successive yaw rates (rad/s) changes; zeros between do not count.

    Example:
        >>> count_reversals([0.5, 0.0, -0.5, -0.1, 0.2])
        2
    """
    turning = [yaw_rate for yaw_rate in yaw_rates if yaw_rate]
    return sum(a * b < 0 for a, b in pairwise(turning))


def turns_per_goal(trajectories: Sequence[Trajectory]) -> Estimate:
    """Full turns of heading, left and right alike, for each goal reached; those of failures count too.

    Circling is the known failure of policies for this task; about 0.45 is healthy.
    """
    return ratio([t.turns for t in trajectories], [t.goal.sum().item() for t in trajectories])


def goals_per_episode(trajectories: Sequence[Trajectory]) -> Estimate:
    """Mean number of goals reached in an episode, where goals keep coming."""
    return ratio([t.goal.sum().item() for t in trajectories])


def seconds_per_goal(trajectories: Sequence[Trajectory]) -> Estimate:
    """All seconds of driving over all goals reached."""
    return ratio([t.seconds for t in trajectories], [t.goal.sum().item() for t in trajectories])


def episode_seconds(trajectories: Sequence[Trajectory]) -> Estimate:
    """Mean seconds that an episode lasted."""
    return ratio([t.seconds for t in trajectories])


def count_runs(flags: Tensor) -> int:
    """How many runs of true values ``flags [T]`` has."""
    flags = flags.to(torch.int8)
    return int(flags[:1].sum() + (flags.diff() > 0).sum())


def touching(trajectories: Sequence[Trajectory], world: World, robot: Robot) -> list[Tensor]:
    """At which poses of each episode the rover's body touches an obstacle: bool ``[T + 1]`` each.

    Its outline, the rectangle around the wheels at the height of their hubs, comes within 1 cm of one. The lidar misses
    that where the body is wider than the lidar is near: at the sides, and behind, where it drives blind. What is lower
    than a wheel's hub is ground to roll over.
    """
    position, angles = (torch.cat([getattr(t, key) for t in trajectories]) for key in ("position", "angles"))
    outline = _outline(robot)
    reach = outline[:, :2].norm(dim=1).max().item() + TOUCH
    touched = torch.zeros(len(position), dtype=torch.bool)
    for obstacle in world.obstacles:
        normals, offsets = obstacle.planes.to(position).split((3, 1), -1)
        near = _near(position[:, :2], obstacle, reach) & ~touched
        for poses in near.nonzero().squeeze(-1).split(_CHUNK):
            points = position[poses, None] + outline @ _rotation(angles[poses]).mT
            touched[poses] = ((points @ normals.T + offsets.T).amax(-1) <= TOUCH).any(-1)
    return list(touched.split([len(t.position) for t in trajectories]))


def _near(path: Tensor, obstacle: Obstacle, reach: float) -> Tensor:
    """Which points of ``path [P, 2]`` are within ``reach`` (m) of the obstacle seen from above: bool ``[P]``."""
    footprint = obstacle.footprint.to(path)
    near = ((path >= footprint.amin(0) - reach) & (path <= footprint.amax(0) + reach)).all(-1)
    near[near.clone()] = distance_to_polygon(path[near], footprint) <= reach
    return near


def _outline(robot: Robot) -> Tensor:
    """Points around the rectangle of the wheels at the height of their hubs, in the base frame: ``[P, 3]``, m."""
    hubs = torch.tensor(robot.wheel_positions)
    margin = torch.tensor((robot.wheel_radius, robot.wheel_width / 2))
    low, high = hubs[:, :2].amin(0) - margin, hubs[:, :2].amax(0) + margin
    x, y = (
        torch.linspace(a, b, math.ceil((b - a) / _OUTLINE_SPACING) + 1)
        for a, b in zip(low.tolist(), high.tolist(), strict=True)
    )
    sides = (torch.cartesian_prod(x, torch.stack((low[1], high[1]))), torch.cartesian_prod(low[:1], y))
    around = torch.cat((*sides, torch.cartesian_prod(high[:1], y)))
    return torch.cat((around, hubs[:, 2].mean().expand(len(around), 1)), -1)


def _rotation(angles: Tensor) -> Tensor:
    """Matrices ``[P, 3, 3]`` (columns: forward, left, up) of roll, pitch and yaw ``[P, 3]`` ('sxyz')."""
    (cr, cp, cy), (sr, sp, sy) = angles.cos().unbind(-1), angles.sin().unbind(-1)
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def goal_metrics(trajectories: Sequence[Trajectory], shortest: Tensor, world: World) -> dict[str, Estimate]:
    """The metrics of episodes with one goal each, by name.

    Args:
        trajectories: an episode each.
        shortest: length of the shortest paths, ``[count]``, m.
        world: where they were driven.
    """
    return {
        "success_rate": success_rate(trajectories),
        "spl": spl(trajectories, shortest),
        "mean_time_to_traverse": mean_time_to_traverse(trajectories),
        "traverse_rate": traverse_rate(trajectories, shortest),
        **_common_metrics(trajectories, world),
    }


def endless_metrics(trajectories: Sequence[Trajectory], world: World) -> dict[str, Estimate]:
    """The metrics of episodes in which goals keep coming, by name."""
    return {
        "goals_per_episode": goals_per_episode(trajectories),
        "seconds_per_goal": seconds_per_goal(trajectories),
        "episode_seconds": episode_seconds(trajectories),
        "ended_early": ending_share(trajectories, *EARLY_ENDINGS),
        **_common_metrics(trajectories, world),
    }


def _common_metrics(trajectories: Sequence[Trajectory], world: World) -> dict[str, Estimate]:
    contacts = [count_runs(touched) for touched in touching(trajectories, world, get_robot("rover_zero"))]
    kinds = (TIME_LIMIT, *EARLY_ENDINGS)
    return {
        "velocity_over_rough_terrain": velocity_over_rough_terrain(trajectories),
        "collisions": collisions(trajectories),
        "body_contacts": ratio(contacts),
        "body_contact_share": proportion(sum(count > 0 for count in contacts), len(contacts)),
        "turns_per_goal": turns_per_goal(trajectories),
        "standstill": standstill(trajectories),
        "command_reversals": command_reversals(trajectories),
        **{f"ending_{kind.replace(' ', '_')}": ending_share(trajectories, kind) for kind in kinds},
    }
