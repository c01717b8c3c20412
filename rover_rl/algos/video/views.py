"""Views of videos: one rover from behind with its lidar, or the whole batch from above."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from torch import Tensor

from rover_rl.algos.evaluation.plots import BLUE, GREEN, ORANGE, PURPLE, RED, SKY, draw_pale_map
from rover_rl.algos.video.recording import Moment, Recording
from rover_rl.robots import Robot
from rover_rl.rotations import quaternion_to_euler, rotate
from rover_rl.sims.movers.draw import parts_from_above
from rover_rl.sims.rendering.renderer import FREE_FRACTION, Camera, Renderer
from rover_rl.sims.rover_state import RoverState
from rover_rl.worlds import World
from rover_rl.worlds.movers.part_kernels import cast_at_movers
from rover_rl.worlds.movers.parts import Parts
from rover_rl.worlds.region import Area, expanded, union

_INCHES = 3.75  # height of every frame, so that text and lines scale with the resolution
_BEAM = "#ffd400"  # color of lidar beams
_EVENT_SECONDS = 1.5  # duration for which an event is shown, s
_ARROWS = "↑↖←↙↓↘→↗"  # directions relative to the rover, counterclockwise from straight ahead
_COLORS = (BLUE, ORANGE, GREEN, PURPLE, RED, SKY)
_ARROWHEAD = ((0.4, 0.0), (-0.28, 0.25), (-0.14, 0.0), (-0.28, -0.25))
"""Outline of a rover's symbol, slightly larger than the rover, m."""
_TRAIL_SECONDS = 6.0  # duration of a trail, s
_MARGIN = 2.5  # margin around the starts and goals, m


class _FrameFigure:
    """Figure with a caption at the bottom and no margins. Only its ``artists`` are redrawn for each frame, in order."""

    def __init__(self, width: int, height: int, columns: Sequence[float]) -> None:
        dpi = height / _INCHES
        # Matplotlib rounds pixels down.
        figure = Figure(figsize=((width + 0.01) / dpi, (height + 0.01) / dpi), dpi=dpi, facecolor="#d1cdc4")
        self._canvas = FigureCanvasAgg(figure)
        self.ax: Axes = figure.add_axes((0, 0, 1, 1))
        self.ax.set_axis_off()
        self.artists: list[Artist] = []
        text: dict[str, Any] = {"transform": self.ax.transAxes, "va": "center", "fontsize": 9.5}
        self._caption = [self.ax.text(column, 0.035, "", color="white", **text) for column in columns]
        halo = withStroke(linewidth=3, foreground="white")
        self._event = self.ax.text(0.5, 0.93, "", ha="center", weight="bold", path_effects=[halo], **text)
        self._band = Rectangle((0, 0), 1, 0.07, transform=self.ax.transAxes, color="black", alpha=0.6, linewidth=0)
        self.ax.add_patch(self._band)
        self._background = None

    def picture(self, caption: Sequence[str], event: str = "", backdrop: np.ndarray | None = None) -> np.ndarray:
        above = [*self.artists, self._band, *self._caption, self._event]
        if self._background is None:
            for artist in above:
                artist.set_animated(True)
            self._canvas.draw()
            self._background = self._canvas.copy_from_bbox(self.ax.bbox)
        for text, part in zip(self._caption, caption, strict=True):
            text.set_text(part)
        self._event.set_text(event)
        if backdrop is None:
            self._canvas.restore_region(self._background)
        else:
            np.asarray(self._canvas.buffer_rgba())[..., :3] = backdrop
        for artist in above:
            self.ax.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


class Rendered(NamedTuple):
    """Rendered picture of a rover, pixels along its lidar beams, ``[beams, points, 2]``, and whether they are seen."""

    image: np.ndarray
    beams: Tensor
    seen: Tensor


class ChaseView:
    """View of the first rover from behind, with the lidar beams that hit something."""

    def __init__(self, recording: Recording, width: int, height: int) -> None:
        self._recording, self._size = recording, (width, height)
        self._renderer = Renderer(recording.world, recording.robot)
        self._figure = _FrameFigure(width, height, (0.03, 0.22, 0.48, 0.8))
        ax = self._figure.ax
        ax.set(xlim=(0, width), ylim=(height, 0))
        beams = (ax.plot([], [], color=_BEAM, linewidth=0.7, alpha=alpha)[0] for alpha in (0.5, 0.1))
        self._beams, self._hidden_beams = beams
        self._hits = ax.scatter([], [], s=5, color=_BEAM, edgecolor="black", linewidth=0.3)
        self._figure.artists += [self._hidden_beams, self._beams, self._hits]
        if recording.moments[0].movers is not None:
            # Here, as it must not happen in two threads at a time.
            hides(recording.moments[0].movers, torch.zeros(3), torch.ones(1, 3))

    def render(self, moment: Moment) -> Rendered:
        """Renders the rover in its world. Several threads may call it."""
        rover, renderer = moment.rover[0], self._renderer
        pose = rover.position.double(), rover.orientation.double()
        camera = Camera.on(*pose, renderer.sight, "chase")
        image = renderer.render_from(camera, *pose, *self._size, moment.goal[0], moment.movers).numpy()
        points = _points(*lidar_hits(moment.rover, moment.scan, self._recording.robot, self._recording.ray_angles))
        pixels, seen = camera.see(points, *self._size)
        if moment.movers is not None:
            seen &= ~hides(moment.movers, camera.eye, points)
        return Rendered(image, pixels, seen)

    def picture(self, moment: Moment, rendered: Rendered) -> np.ndarray:
        rover, pixels, seen = moment.rover[0], rendered.beams, rendered.seen
        shown = seen[:, :-1] & seen[:, 1:]
        # Lines break at points that are not a number.
        segments = torch.stack((pixels[:, :-1], pixels[:, 1:], torch.full_like(pixels[:, 1:], math.nan)), 2)
        for line, drawn in ((self._beams, shown), (self._hidden_beams, ~shown)):
            line.set_data(*segments[drawn].reshape(-1, 2).T.numpy())
        self._hits.set_offsets(pixels[:, -1][seen[:, -1]].numpy())
        away = moment.goal[0] - rover.position[:2]
        bearing = math.atan2(away[1], away[0]) - quaternion_to_euler(rover.orientation)[2].item()
        arrow = _ARROWS[round(bearing / (math.pi / 4)) % 8]
        speed = f"{round(rover.linear_velocity.item(), 2) + 0:.2f} m/s".replace("-", "−")
        goal, goals = f"goal {arrow} {away.norm():.1f} m", f"goals: {moment.goals[0]}"
        event, since = moment.event
        event = event if moment.seconds < since + _EVENT_SECONDS else ""
        return self._figure.picture((f"{moment.seconds:.1f} s", speed, goal, goals), event, rendered.image)


def lidar_beams(rover: RoverState, ranges: Tensor, robot: Robot, angles: Tensor) -> tuple[Tensor, Tensor]:
    """Origins ``[N, 1, 3]`` and ends ``[N, beams, 3]`` of lidar beams, m. Those without a return are NaN."""
    ranges = torch.where(ranges.isfinite(), ranges, torch.nan).cpu().float()[..., None]
    directions = torch.stack((angles.cos(), angles.sin(), torch.zeros_like(angles)), -1).float()
    mount = torch.tensor(robot.lidar_position)
    position, orientation = rover.position.cpu()[:, None], rover.orientation.cpu()[:, None]
    start = position + rotate(orientation, mount.expand(len(position), 1, 3))
    return start, position + rotate(orientation, mount + directions * ranges)


def lidar_hits(rover: RoverState, ranges: Tensor, robot: Robot, angles: Tensor) -> tuple[Tensor, Tensor]:
    """Origin ``[3]`` and hit points ``[hits, 3]`` of the lidar beams of the first rover, m."""
    start, ends = lidar_beams(rover[:1], ranges[:1], robot, angles)
    return start[0, 0], ends[0][ends[0].isfinite().all(-1)]


def _points(start: Tensor, hits: Tensor, count: int = 13) -> Tensor:
    beams = hits - start
    # Without their first 0.35 m, beams do not cover the rover.
    first = (0.35 / beams.norm(dim=-1, keepdim=True)).clamp(max=1)
    shares = first + (1 - first) * torch.linspace(0, 1, count)
    return start + shares[..., None] * beams[:, None]


def hides(movers: Parts, eye: Tensor, points: Tensor) -> Tensor:
    """Whether a mover lies between ``eye [3]`` and ``points [..., 3]`` (m): bool ``[...]``."""
    sight = (points - eye).reshape(1, -1, 3)
    far = torch.full(sight.shape[:2], math.inf)
    shown = movers.chosen(0, torch.from_numpy(movers.in_view(eye.numpy())))
    ranges = cast_at_movers(shown, eye.expand_as(sight), sight, far)
    return (ranges < FREE_FRACTION * sight.norm(dim=-1)).reshape(points.shape[:-1])


class TopView:
    """View of all rovers from above, their trails and goals, with beams and movers of the first one."""

    def __init__(self, recording: Recording, width: int, height: int) -> None:
        self._recording = recording
        world, count = recording.world, len(recording.moments[0].goal)
        self._figure = _FrameFigure(width, height, (0.03, 0.18, 0.4))
        ax = self._figure.ax
        draw_pale_map(ax, world, _area(world, width / height))
        self._colors = np.array([to_rgba(_COLORS[row % len(_COLORS)]) for row in range(count)])
        self._beams = LineCollection([], colors=_COLORS[0], linewidths=0.5, alpha=0.4)
        self._hits = ax.scatter([], [], s=3, color=_COLORS[0])
        self._trails = LineCollection([], linewidths=1.8)
        places = np.zeros(count)
        self._goals = ax.scatter(places, places, s=70, marker="*", color=self._colors, edgecolor="black", linewidth=0.6)
        self._rovers = PolyCollection([], facecolors=self._colors, edgecolors="black", linewidths=0.8)
        self._movers = PolyCollection([], edgecolors="black", linewidths=0.6)
        for collection in (self._beams, self._trails, self._movers, self._rovers):
            ax.add_collection(collection)
        self._figure.artists += [self._beams, self._hits, self._trails, self._goals, self._movers, self._rovers]
        self._past: list[Moment] = []

    def render(self, moment: Moment) -> None:
        """Renders nothing: the map is drawn once."""

    def picture(self, moment: Moment, rendered: None = None) -> np.ndarray:
        rover, recording = moment.rover, self._recording
        self._past = [*(past for past in self._past if past.seconds > moment.seconds - _TRAIL_SECONDS), moment]
        self._draw_trails()
        start, hits = lidar_hits(rover, moment.scan, recording.robot, recording.ray_angles)
        self._beams.set_segments(torch.stack((start.expand_as(hits), hits), 1)[..., :2].tolist())
        self._hits.set_offsets(hits[:, :2].numpy())
        self._goals.set_offsets(moment.goal.numpy())
        if moment.movers is not None:
            self._movers.set(**parts_from_above(moment.movers, recording.world))
        yaw = quaternion_to_euler(rover.orientation)[:, 2]
        turn = torch.stack((yaw.cos(), yaw.sin(), -yaw.sin(), yaw.cos()), -1).unflatten(-1, (2, 2))
        self._rovers.set_verts((rover.position[:, None, :2] + torch.tensor(_ARROWHEAD) @ turn).tolist())
        ended = ", ".join(f"{count} {kind}" for kind, count in Counter(moment.endings).items())
        caption = (f"{moment.seconds:.1f} s", f"goals: {moment.goals.sum()}", f"ended early: {ended or 'none'}")
        return self._figure.picture(caption)

    def _draw_trails(self) -> None:
        points = torch.stack([past.rover.position[:, :2] for past in self._past])
        episodes = torch.stack([past.episodes for past in self._past])
        segments = torch.stack((points[:-1], points[1:]), 2)
        colors = np.tile(self._colors, (len(segments), 1, 1))
        colors[..., 3] = np.linspace(0, 0.9, len(segments))[:, None]
        same = episodes[:-1] == episodes[1:]
        self._trails.set_segments(list(segments[same].numpy()))
        self._trails.set_color(colors[same.numpy()])


def _area(world: World, aspect: float) -> Area:
    ends = expanded(union(world.spawn_range, world.goal_range), _MARGIN)
    (x_center, width), (y_center, height) = (((low + high) / 2, high - low) for low, high in ends)
    width, height = max(width, aspect * height), max(height, width / aspect)
    return (x_center - width / 2, x_center + width / 2), (y_center - height / 2, y_center + height / 2)
