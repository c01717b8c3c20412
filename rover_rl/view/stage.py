"""The stage of a page: rovers and all that is around them, as layers that checkboxes show and hide, and its cameras.

The follow camera moves the world, not the camera: the pages stay free to orbit and zoom, and nothing lags behind.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal, TypeAlias

import numpy as np
import torch
import viser
from numpy.typing import ArrayLike
from torch import Tensor

from rover_rl.algos.video.recording import Moment
from rover_rl.algos.video.session import Pose
from rover_rl.algos.video.views import lidar_beams
from rover_rl.robots import Robot
from rover_rl.rotations import quaternion_to_euler
from rover_rl.sims.rendering.daylight import solid, world_meshes
from rover_rl.sims.rendering.surfaces import Form, Surface, forms_of, part_surface, post_surface, robot_surface
from rover_rl.worlds import World, hull
from rover_rl.worlds.movers.parts import Parts
from rover_rl.worlds.region import union

Route: TypeAlias = Callable[[], Tensor]  # returns the points of the shortest path to a goal, ``[points, 2]``, m
Mode = Literal["follow", "top", "free"]
MODES: tuple[Mode, ...] = ("follow", "top", "free")
ROOT = "/world"  # scene node of everything but light and sky, which the cameras move
BEHIND, OVER_WALLS = (2.8, 1.5), (2.0, 3.4)
"""Distances of the follow camera behind and above the rover at first, m, in the open and among walls."""
WALL = 0.8  # height from which on obstacles are walls, m: the median of their tops
MARGIN = 6.0  # width of what the camera sees from above around starts and goals, m
LOOK_AT = (0.0, 0.0, 0.2)  # point that the cameras look at, relative to the rover, m
SIGHT = 150.0  # distance up to which a click finds the ground, m
_STEP = 0.05  # distance between two points of the line of sight that are compared with the ground, m
_SMOOTHING = 0.2  # share of the way to the rover's height that the camera goes in a frame
Color: TypeAlias = tuple[int, int, int]
RAY, HIT, DRIVEN, SHORTEST = (255, 196, 0), (255, 120, 0), (30, 120, 255), (20, 190, 90)
"""Colors of lidar rays, hits, the driven path and the shortest path."""
PLANNED, TRACKED = (200, 40, 200), (40, 200, 220)
"""Colors of the route that a policy plans on its map, and of the movers that it tracks."""
MARKED = ((150, 20, 40), (235, 90, 60), (250, 190, 60))
"""Colors of the cells of a map: occupied, too close to that for the rover, and narrow."""
MAX_RAYS = 64  # number of lidar rays that are shown at most
MAX_HITS = 20_000  # number of lidar hits that are shown at most. Of more rovers, every second, third ... beam is shown
FEW = 128  # number of copies up to which distant ones are drawn as finely as near ones
OTHERS = 0.4  # size of the goals of rovers that are not followed
CIRCLE = np.stack([(np.cos(angle), np.sin(angle)) for angle in np.linspace(0, 2 * np.pi, 17)])
"""Outline of a tracked mover, as a polygon around a circle of radius 1 that ends where it begins."""
MAX_PATH = 4_000  # number of points of the driven path that are kept
MAP = "map of the policy"
LAYERS = ("rovers", "lidar rays", "lidar hits", "goals", "driven path", "shortest path", "movers", MAP)
"""What checkboxes show and hide. The map is hidden at first."""
CUT = 1.2  # height above the ground at which walls are cut, m
_THIN, _LONG = 0.6, 1.0  # what is thinner and longer than this is a wall, a lintel or a ceiling, m
_LIFT = 0.04  # height of paths above the ground, m
_SPACING = 0.05  # distance between two points of the driven path, m
_JUMP = 1.0  # distance of a rover from the last point of its path from which it was put elsewhere, m
_SEGMENTS = 128  # numbers of line segments of a node are multiples of this, so that nodes are seldom made anew
_NO_ROTATION = (0.0, 0.0, 0.0, 1.0)


class Cameras:
    """Cameras of all clients of a page."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self.mode, self._offset = server, MODES[0], np.zeros(3)
        self._yaw, self._span, self._center, self._steep = 0.0, 10.0, np.zeros(3), False
        self._root = server.scene.add_frame(ROOT, show_axes=False)
        server.on_client_connect(self._aim)

    def enter(self, world: World) -> None:
        """Sees a new world as a whole from above, and over its walls from behind a rover."""
        tops = [(one.vertices[:, 2] - world.height_at(one.vertices[:, :2])).max() for one in world.obstacles]
        self._steep = bool(tops) and torch.stack(tops).median().item() > WALL
        (left, right), (bottom, top) = union(world.spawn_range, world.goal_range)
        self._span = max(right - left, top - bottom) + MARGIN
        self._center = np.array(((left + right) / 2, (bottom + top) / 2, 0.0))
        self.select(self.mode)

    def select(self, mode: Mode) -> None:
        """Selects a camera for all clients. The free one starts where the last one was."""
        self.mode = mode
        if mode == "top":
            self._move(-self._center)
        if mode != "free":
            for client in self._server.get_clients().values():
                self._aim(client)

    def follow(self, position: np.ndarray, yaw: float) -> None:
        """Lets the follow camera see a rover at ``position [3]`` (m) with a heading (rad)."""
        self._yaw = yaw
        if self.mode != "follow":
            return
        lag = -position[2] - self._offset[2]
        height = self._offset[2] + (lag if abs(lag) > 1.0 else _SMOOTHING * lag)
        self._move(np.array((-position[0], -position[1], height)))

    def ground_at(self, world: World, eye: ArrayLike, toward: ArrayLike) -> tuple[float, float] | None:
        """Point of the ground in a direction from the camera, x and y (m); ``None`` for the sky."""
        start, direction = np.array(eye) - self._offset, np.array(toward) / np.linalg.norm(toward)
        points = torch.from_numpy(start + np.arange(0, SIGHT, _STEP)[:, None] * direction)
        (left, right), (bottom, top) = world.terrain.extent
        x, y, z = points.unbind(-1)
        on_terrain = (left <= x) & (x <= right) & (bottom <= y) & (y <= top)
        below = (on_terrain & (z <= world.height_at(points[:, :2]))).nonzero()
        return None if not len(below) else (x[below[0, 0]].item(), y[below[0, 0]].item())

    def _move(self, offset: np.ndarray) -> None:
        self._offset = self._root.position = offset

    def _aim(self, client: viser.ClientHandle) -> None:
        """Puts the camera of a client to where its mode has it at first."""
        client.camera.up_direction = (0.0, 1.0, 0.0) if self.mode == "top" else (0.0, 0.0, 1.0)
        client.camera.position, client.camera.look_at = self.place(), LOOK_AT

    def place(self) -> np.ndarray:
        """Where the camera is at first, ``[3]``, m: behind the rover, or above the world."""
        if self.mode == "top":
            return np.array((0.0, -0.01, 1.05 * self._span))
        behind, above = OVER_WALLS if self._steep else BEHIND
        return np.array((-behind * np.cos(self._yaw), -behind * np.sin(self._yaw), above))


def without_high_walls(world: World) -> World:
    """A world for the eye: high walls, which hide rovers, are cut, and what hangs above is left out.

    Rocks, trunks and all that is thick stay whole.
    """
    kept = []
    for obstacle in world.obstacles:
        points = obstacle.vertices
        ground = world.height_at(points[:, :2])
        bottom, top = (points[:, 2] - ground).aminmax()
        # Extents along the principal axes of the outline, so that walls may stand at any angle.
        flat = points[:, :2] - points[:, :2].mean(0)
        low, high = (flat @ torch.linalg.svd(flat, full_matrices=False)[2].T).aminmax(dim=0)
        width, length = (high - low).sort()[0].tolist()
        if top > CUT and length > _LONG and min(width, float(top - bottom)) < _THIN:
            if bottom > CUT / 2:
                continue
            cut = torch.minimum(points[:, 2], ground + CUT)
            obstacle = hull(torch.cat((points[:, :2], cut[:, None]), 1))
        kept.append(obstacle)
    return replace(world, obstacles=kept)


class Stage:
    """Shows moments of rovers in a world, on a page. ``shown`` tells which layers are shown."""

    world: World

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self.cameras = server, Cameras(server)
        self._robot: Robot | None = None
        self.shown: dict[str, bool] = {}
        self.on_drag: Callable[[viser.SceneNodeDragEvent], None] | None = None
        self._nodes: dict[str, viser.SceneNodeHandle] = {}
        self._forms: dict[Form, int] = {}
        self._path: list[np.ndarray] = []
        for layer in LAYERS:
            self.show_layer(layer, layer != MAP)

    def enter(self, world: World, robot: Robot, ray_angles: Tensor) -> None:
        """Shows a world for a robot, with the direction of each lidar beam in its frame, ``[beams]``, rad."""
        self._angles = ray_angles
        if robot is not self._robot:
            self._robot = robot
            self._forget("rovers/")
        if world is getattr(self, "world", None):
            return
        self.world = world
        meshes = world_meshes(without_high_walls(world))
        for name in ("ground", "land", "obstacles"):
            if name in meshes:
                # Its shadows are in its colors.
                self._server.scene.add_mesh_trimesh(f"{ROOT}/{name}", meshes[name], cast_shadow=False)
            else:
                self._server.scene.remove_by_name(f"{ROOT}/{name}")
        self._forget("movers/")
        self._forms.clear()
        self.forget_path()
        self.cameras.enter(world)

    def _forget(self, prefix: str) -> None:
        for key in [key for key in self._nodes if key.startswith(prefix)]:
            self._nodes.pop(key).remove()

    def forget_path(self) -> None:
        self._path.clear()
        self._goal: Tensor | None = None
        for layer, color in (("driven path", DRIVEN), ("shortest path", SHORTEST)):
            self._lines(layer, np.zeros((0, 2, 3)), color)

    def add_controls(self) -> None:
        gui = self._server.gui
        mode = gui.add_dropdown("Camera", MODES, initial_value=MODES[0])
        mode.on_update(lambda _: self.cameras.select(mode.value))
        for layer in LAYERS:
            box = gui.add_checkbox(layer, self.shown[layer])
            box.on_update(lambda _, layer=layer, box=box: self.show_layer(layer, box.value))

    def show_layer(self, layer: str, shown: bool) -> None:
        self.shown[layer] = shown
        self._server.scene.add_frame(self._name(layer), show_axes=False, visible=shown)

    def show(self, moment: Moment, row: int, rows: Tensor, pose: Pose, route: Route | None = None) -> None:
        """Shows the rovers ``rows`` (int64) in a moment of all rovers, and lets the camera follow the rover ``row``.

        That one's rays, path and movers are shown, and its shortest path, which ``route`` returns for each new goal.
        ``pose``, at which rovers are drawn, may be between two moments.
        """
        assert self._robot is not None
        surface = partial(robot_surface, self._robot)
        self._many("rovers/rover", surface, pose.position[rows].numpy(), pose.orientation[rows].numpy())
        if self.shown["lidar rays"] or self.shown["lidar hits"]:
            self._show_lidar(moment, row, rows)
        if self.shown["goals"]:
            places = self._on_ground(moment.goal[rows].cpu(), 0.0)
            scales = np.where(rows.numpy() == row, 1.0, OTHERS)
            self._many("goals/post", post_surface, places, np.tile(_NO_ROTATION, (len(places), 1)), scales)
        if moment.movers is not None and self.shown["movers"]:
            self._show_movers(moment.movers)
        self._extend_path(pose.position[row].numpy())
        yaw = quaternion_to_euler(pose.orientation[row : row + 1])[0, 2].item()
        self.cameras.follow(pose.position[row].numpy(), yaw)
        if route is not None and (self._goal is None or not moment.goal[row].equal(self._goal)):
            self._goal = moment.goal[row]
            self._polyline("shortest path", self._on_ground(route()), SHORTEST)

    def show_map(self, seen: tuple[Tensor, Tensor] | None, tracked: Tensor) -> None:
        """Shows what a policy has seen, its route, and the movers that it tracks, with their ways of the next second.

        The arguments are those that ``Session.seen_map`` and ``Session.tracked`` return.
        """
        cells, route = seen or (torch.zeros(0, 3), torch.zeros(0, 2))
        for level, color in enumerate(MARKED):
            self._cloud(f"{MAP}/{level}", self._on_ground(cells[cells[:, 2] == level, :2]), color, 0.06)
        self._polyline(f"{MAP}/route", self._on_ground(route), PLANNED)
        place, velocity, radius = tracked[:, None].split((2, 2, 1), -1)
        outline = place + radius * torch.from_numpy(CIRCLE).float()
        sides = torch.stack((outline[:, :-1], outline[:, 1:]), 2).reshape(-1, 2)
        ends = torch.cat((sides, torch.cat((place, place + velocity), 1).reshape(-1, 2)))
        self._lines(f"{MAP}/movers", self._on_ground(ends).reshape(-1, 2, 3), TRACKED)

    def _on_ground(self, places: Tensor, lift: float = _LIFT) -> np.ndarray:
        """Points just above the ground, ``[n, 3]``, at ``places [n, 2]``, m."""
        return torch.cat((places, self.world.height_at(places.double()).float()[:, None] + lift), -1).numpy()

    def _name(self, layer: str) -> str:
        return f"{ROOT}/{layer.replace(' ', '_')}"

    def _extend_path(self, position: np.ndarray) -> None:
        step = np.linalg.norm(position[:2] - self._path[-1][:2]) if self._path else np.inf
        if step < _SPACING:
            return
        if step > _JUMP:
            self._path.clear()
        self._path = [*self._path[-MAX_PATH:], self._on_ground(torch.from_numpy(position[None, :2]))[0]]
        self._polyline("driven path", np.array(self._path), DRIVEN)

    def _show_lidar(self, moment: Moment, row: int, rows: Tensor) -> None:
        """Shows where the beams of all rovers hit something, and the beams of the followed one."""
        assert self._robot is not None
        stride = max(1, -(-len(rows) * len(self._angles) // MAX_HITS))
        starts, ends = lidar_beams(moment.rover[rows], moment.scan[rows, ::stride], self._robot, self._angles[::stride])
        self._cloud("lidar hits", ends[ends.isfinite().all(-1)].numpy(), HIT, 0.04)
        own = rows.tolist().index(row)
        hit = ends[own].isfinite().all(-1)
        rays = torch.stack((starts[own].expand_as(ends[own]), ends[own]), 1)[hit][:: -(-len(self._angles) // MAX_RAYS)]
        self._lines("lidar rays", rays.numpy(), RAY, 0.006)

    def _show_movers(self, parts: Parts) -> None:
        """Shows the movers of a row: those of the same form in one node. Other rovers of a group are shown already."""
        groups: dict[Form, list[int]] = {}
        for part, form in enumerate(forms_of(self.world, parts)):
            if parts.mover[0, part] < len(self.world.movers):
                groups.setdefault(form, []).append(part)
        for form, members in groups.items():
            key, surface = f"movers/form{self._forms.setdefault(form, len(self._forms))}", partial(part_surface, form)
            self._many(key, surface, parts.position[0, members].numpy(), parts.orientation[0, members].numpy())

    def _cloud(self, layer: str, points: np.ndarray, color: Color, size: float) -> None:
        if isinstance(cloud := self._nodes.get(layer), viser.PointCloudHandle):
            cloud.points = points
            return
        style: dict[str, Any] = {"point_size": size, "point_shape": "circle", "precision": "float32"}
        name = f"{self._name(layer)}/points"
        self._nodes[layer] = self._server.scene.add_point_cloud(name, points, color, point_shading="flat", **style)

    def _polyline(self, layer: str, points: np.ndarray, color: Color) -> None:
        self._lines(layer, np.stack((points[:-1], points[1:]), 1), color)

    def _lines(self, layer: str, points: np.ndarray, color: Color, thickness: float = 0.05) -> None:
        """Shows line segments ``[n, 2, 3]``, m. Segments without a length fill them up, so that few numbers occur."""
        filled = np.zeros((-(-(len(points) + 1) // _SEGMENTS) * _SEGMENTS, 2, 3), dtype=np.float32)
        filled[: len(points)] = points
        if len(points):
            filled[len(points) :] = points[-1, 1]
        node = self._nodes.get(layer)
        if isinstance(node, viser.LineSegmentsHandle) and len(node.points) == len(filled):
            node.points = filled
            return
        name = f"{self._name(layer)}/lines"
        self._nodes[layer] = self._server.scene.add_line_segments(name, filled, color, thickness=thickness)

    def _many(
        self, key: str, surface: Callable[[], Surface], position: np.ndarray, xyzw: np.ndarray, scales: Any = None
    ) -> None:
        """Shows copies of a surface, in the layer that ``key`` begins with. A change of their number makes a node."""
        node, wxyz = self._nodes.get(key), xyzw[:, [3, 0, 1, 2]]
        if isinstance(node, viser.BatchedGlbHandle) and len(node.batched_positions) == len(position):
            node.batched_positions, node.batched_wxyzs, node.batched_scales = position, wxyz, scales
            return
        options: dict[str, Any] = {"batched_scales": scales, "lod": "off" if len(position) <= FEW else "auto"}
        mesh = solid(surface())
        node = self._server.scene.add_batched_meshes_trimesh(f"{ROOT}/{key}", mesh, wxyz, position, **options)
        self._nodes[key] = node
        if key == "rovers/rover" and self.on_drag is not None:
            node.on_drag(self.on_drag)
