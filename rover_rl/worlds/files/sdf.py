"""SDF worlds and models of Gazebo Classic and Gazebo Sim."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.option_names import written
from rover_rl.tiny_xml import is_true, numbers, parse_xml, read_xml, text_of
from rover_rl.worlds.files.contents import Contents, Grid, Piece, Plane, listed
from rover_rl.worlds.files.elevation import read_elevations
from rover_rl.worlds.files.locate import Locator
from rover_rl.worlds.files.options import MAX_SIZE, MESH_SUFFIXES, TIFF_SUFFIXES, ImportOptions
from rover_rl.worlds.files.shapes import KINDS, prisms, solid_points
from rover_rl.worlds.files.triangles import read_mesh
from rover_rl.worlds.movers import Mover, Person, Waypoints

MOVING = re.compile(
    "velocity|joint(?!.?state)|traject|drive|mov(?:e|ing)|actor|animat|convey|patrol|elevator|steer", re.I
)
"""What is in the name of a plugin that moves its model: VelocityControl, JointController, TrajectoryFollower."""
STRAY = 1_000.0
"""Distance from the origin beyond which a piece is left out that is ten times as far as all others, m."""
UPRIGHT = math.cos(math.radians(60))
"""Least z component of the normal of a plane that is ground."""
GROUND_PLANE = (
    b"<model name='ground_plane'><static>1</static><link name='link'><collision name='collision'>"
    b"<geometry><plane><normal>0 0 1</normal><size>100 100</size></plane></geometry></collision></link></model>"
)
"""The model ``ground_plane`` of Gazebo."""
OWN_FRAMES = ("", "__model__", "world", "__root__")
MOVE, DRIVEN, JOINTED, OFF = (
    "models that are not static do not move",
    "models that plugins move in Gazebo stand still",
    "models that are not static and have joints are left out",
    "collisions that stop nothing are left out",
)


@dataclass
class _Model:
    """A model or an actor, or the world.

    ``title`` is what messages call it, and ``path`` has the names of the models down to it, with slashes. ``state`` is
    what a saved world says of it in place of its own file, ``static`` whether it or a parent is, and ``files`` are
    those on the way to it, to find circles. ``transform`` is its pose in the world, ``[4, 4]``. The frames of
    ``merged`` children are its own. ``frames`` are functions that return a pose and the frame that it is relative to,
    by name: a pose is read when it is needed, so that a wrong one spoils nothing else.
    """

    element: Element
    file: Path
    title: str
    path: str = ""
    state: Element = field(default_factory=lambda: Element("state"))
    static: bool = False
    files: tuple[Path, ...] = ()
    transform: np.ndarray = field(default_factory=partial(np.eye, 4))
    children: dict[str, _Model] = field(default_factory=dict)
    merged: list[tuple[str, _Model]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.frames: dict[str, Callable[[], tuple[np.ndarray, str]]] = {}
        for part in (part for tag in ("link", "joint", "frame") for part in self.element.findall(tag)):
            # A joint's frame is that of its child link; before SDF 1.7 the child is not a frame elsewhere.
            default = text_of(part.find("child")) if part.tag == "joint" else part.get("attached_to", "")
            self.frames[part.get("name", "")] = partial(self._own, part, default)

    def _own(self, part: Element, default: str) -> tuple[np.ndarray, str]:
        transform, base = _pose_of(part, f"{part.get('name', '')!r} in {self.title}")
        return transform, base or default

    def pose(self, name: str, below: tuple[str, ...] = ()) -> np.ndarray:
        """Returns the transform of a frame in that of the model, ``[4, 4]``."""
        if name in OWN_FRAMES:
            return np.eye(4)
        if name in below:
            raise ValueError(f"the frame {name!r} of {self.title} is relative to itself, through others")
        if name in self.frames:
            transform, base = self.frames[name]()
            return self.pose(base, (*below, name)) @ transform
        first, _, rest = name.partition("::")
        if rest and first in self.children:
            return self.pose(first, (*below, name)) @ self.children[first].pose(rest)
        for child, model in self.merged:
            if name in model.frames:
                return self.pose(child, (*below, name)) @ model.pose(name)
        raise ValueError(f"{self.title} has no frame {name!r}; it has {sorted(self.frames)[:20]}")


def read_sdf(path: Path, options: ImportOptions) -> Contents:
    """Reads an SDF file with a world or a model."""
    top = _root(path)
    world = top.find("world")
    top = top if world is None else world
    own, given = path.name.partition(".")[0], top.get("name", "")
    # Gazebo's own template is called "default", and so are most worlds that were saved from it.
    contents = Contents(own if given in ("", "default") else given)
    locator = Locator(path, options.model_paths)
    reader = _Reader(contents, locator, options)
    saved = top.find("state")
    saved = Element("state") if saved is None else saved
    top.extend(saved.findall("insertions/model"))
    reader.read_children(_Model(top, path, "the world", state=saved, files=(path.resolve(),)))
    if top.find("population") is not None:
        contents.left_out.append("a <population> is random in Gazebo, and left out")
    if locator.missing and options.missing == "error":
        raise ValueError(
            f"{path} needs what is not here: {listed(locator.missing, 50)}; name their folders with "
            f"{written('model_paths')}, download them, or leave them out with {written('missing', 'skip')}"
        )
    if locator.missing:
        contents.left_out.append(f"left out, as {written('missing', 'skip')} says: {listed(locator.missing, 50)}")
    if contents.wrong and not (contents.pieces or contents.grids or contents.movers):
        raise contents.wrong[0]
    away = sorted((float(np.linalg.norm(piece.vertices, axis=1).min()), n) for n, piece in enumerate(contents.pieces))
    for k in range((len(away) + 1) // 2, len(away)):
        if away[k][0] > max(STRAY, 10 * away[k - 1][0]):
            names = listed(contents.pieces[n].name for _, n in away[k:])
            contents.pieces = [contents.pieces[n] for n in sorted(n for _, n in away[:k])]
            contents.left_out.append(f"left out, as they are more than {STRAY / 1000:g} km from all others: {names}")
            break
    contents.left_out += [f"{sentence}: {listed(names)}" for sentence, names in reader.told.items() if names]
    if contents.wrong:
        contents.left_out.append(f"left out, as they are wrong: {listed(map(str, contents.wrong), 20)}")
    if reader.shown:
        contents.notes.append(f"links without collision geometry have their visual one: {listed(reader.shown)}")
    if locator.elsewhere:
        contents.notes.append(f"files found by their names: {listed(locator.elsewhere)}")
    return contents


def _root(path: Path) -> Element:
    root = read_xml(path)
    if root.tag != "sdf":
        raise ValueError(f"{path} is not SDF: its root is <{root.tag[:40]}>, not <sdf>")
    version = re.fullmatch(r"1\.(\d+)(\.\d+)?", root.get("version", "").strip())
    if not version or not 4 <= int(version[1]) <= 12:
        raise ValueError(f"{path} has the SDF version {root.get('version')!r}; 1.4 to 1.12 are supported")
    return root


class _Reader:
    """Walks through a world and collects shapes and actors.

    ``told`` has the names of what is not as in Gazebo, by sentence, and ``shown`` the links whose visual geometry
    counts.
    """

    def __init__(self, contents: Contents, locator: Locator, options: ImportOptions) -> None:
        self._contents, self._locator, self._options = contents, locator, options
        self.told: dict[str, list[str]] = {sentence: [] for sentence in (MOVE, DRIVEN, JOINTED, OFF)}
        self.shown: list[str] = []
        self._roots: dict[Path, Element] = {}
        self._meshes: dict[Path, list[Piece]] = {}

    def read_children(self, parent: _Model) -> None:
        """Reads the models, includes and actors in a model or a world."""
        deleted = {text_of(name) for name in parent.state.findall("deletions/name")}
        found: list[tuple[Element, Path, Element]] = []
        for element in parent.element:
            with self._contents.leaving_out():
                if element.tag == "include":
                    found += self._included(element, parent)
                elif element.tag in ("model", "actor"):
                    found.append((element, parent.file, Element("include")))
        children = [self._enter(*each, parent) for each in found]
        for name, child in children:
            if name in deleted:
                continue
            placed = False
            with self._contents.leaving_out():
                child.transform = parent.transform @ parent.pose(name)
                placed = True
                if child.element.tag == "actor":
                    self._actor(child.element, child.transform, name)
            if placed and child.element.tag == "model":
                self._model(child)

    def _included(self, include: Element, parent: _Model) -> list[tuple[Element, Path, Element]]:
        uri = text_of(include.find("uri"))
        if not uri:
            raise ValueError(f"an <include> in {parent.file} has no uri")
        path = self._locator.file(uri, parent.file.parent, _model_file)
        if path is None:
            name = re.sub(r"(/tip|/\d+|/model.sdf)?/*$", "", unquote(uri)).rpartition("/")[2].lower().replace(" ", "_")
            if name not in ("sun", "ground_plane"):
                return []
            # Gazebo's own models need no files.
            self._locator.missing.pop()
            return [] if name == "sun" else [(parse_xml(GROUND_PLANE), parent.file, include)]
        if path.resolve() in parent.files:
            raise ValueError(f"{path} includes itself")
        if path not in self._roots:
            self._roots[path] = _root(path)
        found = [child for child in self._roots[path] if child.tag in ("model", "actor")]
        return [(found[0], path, include)] if found else []

    def _enter(self, element: Element, file: Path, include: Element, parent: _Model) -> tuple[str, _Model]:
        """Adds a model to the frames of its parent; returns its name there, and the model."""
        name = text_of(include.find("name")) or element.get("name", "")
        saved = _named(parent.state, "model", name)

        def pose() -> tuple[np.ndarray, str]:
            if saved.find("pose") is not None:
                # A saved state has poses in the world.
                return np.linalg.inv(parent.transform) @ _pose_of(saved, f"the state of {name!r}")[0], ""
            source = element if include.find("pose") is None else include
            transform, base = _pose_of(source, f"{element.tag} {name!r} in {file.name}")
            placement = text_of(include.find("placement_frame")) or element.get("placement_frame", "")
            return transform @ np.linalg.inv(child.pose(placement)), base

        # Gazebo gives a second model of the same name another one.
        unique = name
        while unique in parent.frames:
            unique += "_"
        # What the include says about its model counts.
        static = is_true((element if include.find("static") is None else include).find("static"))
        path, state = f"{parent.path}/{unique}".lstrip("/"), _named(parent.state, "model", unique)
        files = (*parent.files, file.resolve())
        child = _Model(element, file, f"the model {name!r}", path, state, parent.static or static, files)
        parent.frames[unique] = pose
        parent.children[unique] = child
        if include.get("merge", "").lower() in ("1", "true"):
            parent.merged.append((unique, child))
        return unique, child

    def _model(self, model: _Model) -> None:
        movers = [name for plugin in model.element.findall("plugin") if (name := _mover(plugin))]
        if movers:
            self.told[DRIVEN].append(f"{model.path} ({', '.join(movers)})")
        if not model.static and not is_true(model.element.find("static")):
            if _has_movable_joints(model.element):
                self.told[JOINTED].append(model.path)
                return
            if model.element.findall("link"):
                self.told[MOVE].append(model.path)
        self.read_children(model)
        for link in model.element.findall("link"):
            name = f"{model.path}/{link.get('name', '')}"
            parts = link.findall("collision")
            if not parts and self._options.visuals:
                parts = link.findall("visual")
                self.shown += [name] if parts else []
            for part in parts:
                own, geometry = f"{name}/{part.get('name', '')}", part.find("geometry")
                with self._contents.leaving_out(own):
                    if geometry is not None and _is_off(part):
                        self.told[OFF].append(own)
                    elif geometry is not None:
                        self._add(geometry, self._placed(part, link, model), own, model.file.parent)

    def _placed(self, part: Element, link: Element, model: _Model) -> np.ndarray:
        name = link.get("name", "")
        pose, base = _pose_of(part, f"{part.tag} {part.get('name', '')!r} of {model.path}/{name}")
        saved = _named(model.state, "link", name)
        if not base and saved.find("pose") is not None:
            at = _pose_of(saved, f"the state of {model.path}/{name}")[0]
        else:
            # Without relative_to, a pose is relative to the link.
            at = model.transform @ model.pose(base or name)
        scale = numbers(model.state.find("scale"), 3, (1, 1, 1), f"the scale in the state of {model.path}")
        # Gazebo Classic ignores scales that are negative.
        return at @ pose @ np.diag((*(scale if (scale > 0).all() else (1, 1, 1)), 1))

    def _actor(self, actor: Element, transform: np.ndarray, name: str) -> None:
        script = actor.find("script")
        script = Element("script") if script is None else script
        keys = []
        for waypoint in script.findall("trajectory/waypoint"):
            (time,) = numbers(waypoint.find("time"), 1, None, f"a waypoint's time of {name!r}").tolist()
            keys.append((time, *_ground_pose(transform @ _pose_of(waypoint, f"a waypoint of {name!r}")[0])))
        keys.sort(key=lambda key: key[0])
        loop, auto = (flag is None or is_true(flag) for flag in map(script.find, ("loop", "auto_start")))
        delay = numbers(script.find("delay_start"), 1, (0,), f"delay_start of {name!r}")
        # An actor that does not start by itself stands at its first waypoint.
        keys = (keys if auto else keys[:1]) or [(0.0, *_ground_pose(transform))]
        motion = Waypoints(keys, "loop" if loop and keys[-1][0] > 0 else "once", delay=float(delay[0]))
        self._contents.movers.append(Mover(motion, Person(), name))

    def _add(self, geometry: Element, transform: np.ndarray, name: str, folder: Path) -> None:
        """Adds the shape in a ``<geometry>``, by its pose in the world, ``[4, 4]``, and the folder of its file."""
        for shape in geometry:
            what, solids = f"the {shape.tag} of {name}", list[np.ndarray]()
            if shape.tag == "plane":
                self._plane(shape, transform, name)
            elif shape.tag == "heightmap":
                self._heightmap(shape, transform, name, folder)
            elif shape.tag == "mesh":
                self._mesh(shape, transform, name, folder)
            elif shape.tag in KINDS:
                solids = [solid_points(shape, what)]
            elif shape is geometry.find("polyline"):
                solids = prisms(geometry.findall("polyline"), what)
            elif shape.tag not in ("empty", "polyline"):
                self._contents.left_out.append(f"{name}: shapes of the kind <{shape.tag}> are left out")
            self._contents.pieces += [Piece(name, points @ transform[:3, :3].T + transform[:3, 3]) for points in solids]

    def _plane(self, shape: Element, transform: np.ndarray, name: str) -> None:
        normal = numbers(shape.find("normal"), 3, (0, 0, 1), f"the normal of {name}")
        width, depth = numbers(shape.find("size"), 2, (1, 1), f"the size of {name}")
        if np.linalg.norm(normal) < 1e-9:
            raise ValueError(f"the normal of {name} must not be 0")
        normal = np.linalg.inv(transform[:3, :3]).T @ normal
        normal /= np.linalg.norm(normal)
        if normal[2] < UPRIGHT:
            self._contents.left_out.append(f"{name}: a plane that is steeper than 60 degrees is left out")
            return
        if normal[2] > 1 - 1e-9:
            normal = np.array((0.0, 0.0, 1.0))
        point = Piece(name, transform[None, :3, 3]).vertices[0]
        self._contents.planes.append(Plane(point, normal, (abs(float(width)), abs(float(depth)))))

    def _mesh(self, shape: Element, transform: np.ndarray, name: str, folder: Path) -> None:
        path = self._find(shape, folder, name)
        if path is None:
            return
        if path.suffix.lower() not in MESH_SUFFIXES:
            raise ValueError(f"{path} is no mesh; use one of {[*MESH_SUFFIXES]}")
        scale = numbers(shape.find("scale"), 3, (1, 1, 1), f"the scale of {name}")
        if (scale == 0).any():
            raise ValueError(f"the scale of {name} must not be 0")
        if path not in self._meshes:
            # Gazebo takes the coordinates of a mesh as they are, whichever axis its format has up; the unit counts.
            self._meshes[path] = read_mesh(path, up="z")
        pieces = self._meshes[path]
        transform = transform @ np.diag((*scale, 1.0))
        submesh = shape.find("submesh")
        if submesh is not None:
            wanted = text_of(submesh.find("name"))
            pieces = [piece for piece in pieces if piece.name == wanted]
            if not pieces:
                names = sorted({piece.name for piece in self._meshes[path]})
                raise ValueError(f"{path} has no submesh {wanted!r} for {name}; it has {names[:20]}")
            if is_true(submesh.find("center")):
                points = np.concatenate([piece.vertices for piece in pieces])
                center = np.eye(4)
                center[:3, 3] = -(points.min(0) + points.max(0)) / 2
                transform = transform @ center
        self._contents.pieces += [
            Piece(f"{name}/{piece.name}", piece.points, piece.faces, transform @ piece.pose) for piece in pieces
        ]

    def _heightmap(self, shape: Element, transform: np.ndarray, name: str, folder: Path) -> None:
        """Adds an elevation map as Gazebo does: the outermost values at the ends of ``size``, the first row at +y.

        Pictures are scaled so that the brightest pixel is as high as ``size`` says, and elevation models about their
        lowest point so that their range is that high (gz-common: ``ImageHeightmap::FillHeightMap``,
        ``Dem::FillHeightMap``; gz-physics: ``CustomHeightmapShape``).
        """
        path = self._find(shape, folder, name)
        if path is None:
            return
        size = numbers(shape.find("size"), 3, (1, 1, 1), f"the size of {name}")
        if min(size[:2]) <= 0 or np.abs(size).max() > 2 * MAX_SIZE:
            raise ValueError(f"the size of {name} must be positive and at most {2 * MAX_SIZE:g} m, got {size.tolist()}")
        if abs(transform[2, 2] - 1) > 1e-6:
            raise ValueError(f"the elevation map of {name} is tilted, which is not supported")
        values = read_elevations(path).values[::-1]
        low, high = float(np.nanmin(values)), float(np.nanmax(values))
        if path.suffix.lower() in TIFF_SUFFIXES:
            values = low + (values - low) * (abs(size[2]) / (high - low) if high > low else 1.0)
        else:
            values = values / (high if high > 0 else 1.0) * size[2]
        rows, columns = values.shape
        offset = numbers(shape.find("pos"), 3, (0, 0, 0), f"the pos of {name}")
        corner = transform @ np.array([offset[0] - size[0] / 2, offset[1] - size[1] / 2, offset[2], 1.0])
        Piece(name, corner[None, :3])
        cell = float(size[0]) / (columns - 1), float(size[1]) / (rows - 1)
        yaw = math.atan2(transform[1, 0], transform[0, 0])
        self._contents.grids.append(Grid(values + corner[2], cell, (float(corner[0]), float(corner[1])), yaw))

    def _find(self, shape: Element, folder: Path, name: str) -> Path | None:
        uri = text_of(shape.find("uri"))
        if not uri:
            raise ValueError(f"the {shape.tag} of {name} has no uri")
        return self._locator.file(uri, folder)


def _pose_of(element: Element, what: str) -> tuple[np.ndarray, str]:
    """Returns the pose in the ``<pose>`` of an element, ``[4, 4]``, and the frame that it is relative to, or ``""``."""
    pose = element.find("pose")
    transform = np.eye(4)
    if pose is None:
        return transform, ""
    what = f"the pose of {what}"
    if pose.get("rotation_format", "euler_rpy") == "quat_xyzw":
        values = numbers(pose, 7, (0, 0, 0, 0, 0, 0, 1), what)
        if np.linalg.norm(values[3:]) < 1e-6:
            raise ValueError(f"{what} has a quaternion of length 0")
        rotation = Rotation.from_quat(values[3:])
    else:
        values = numbers(pose, 6, (0,) * 6, what)
        degrees = pose.get("degrees", "false").lower() in ("1", "true")
        # SDF: roll, pitch and yaw about the fixed x, y and z axes, in this order.
        rotation = Rotation.from_euler("xyz", values[3:], degrees=degrees)
    transform[:3, :3], transform[:3, 3] = rotation.as_matrix(), values[:3]
    # SDF 1.5 and 1.6 call the attribute "frame".
    return transform, pose.get("relative_to", pose.get("frame", "")).strip()


def _ground_pose(transform: np.ndarray) -> tuple[float, float, float]:
    return float(transform[0, 3]), float(transform[1, 3]), math.atan2(transform[1, 0], transform[0, 0])


def _mover(plugin: Element) -> str:
    name = plugin.get("name", "") or plugin.get("filename", "")
    moves = any(MOVING.search(text) for text in (name, plugin.get("filename", "")))
    return name.rpartition("::")[2] if moves else ""


def _has_movable_joints(model: Element) -> bool:
    joints = any(joint.get("type", "fixed") != "fixed" for joint in model.findall("joint"))
    return joints or any(map(_has_movable_joints, model.findall("model")))


def _model_file(folder: Path) -> Path | None:
    """Returns the file of a model: the newest one that its configuration names, else ``model.sdf``."""
    config = next((folder / name for name in ("model.config", "manifest.xml") if (folder / name).is_file()), None)
    files = [] if config is None else read_xml(config).findall("sdf")
    versions = [([*map(int, re.findall(r"\d+", file.get("version", "0")))], text_of(file)) for file in files]
    names = [name for _, name in sorted(versions, reverse=True)]
    paths = (folder / name for name in (*names, "model.sdf") if Path(name).name == name)
    return next((path for path in paths if path.is_file()), None)


def _named(parent: Element, tag: str, name: str) -> Element:
    return next((child for child in parent.findall(tag) if child.get("name") == name), Element(tag))


def _is_off(collision: Element) -> bool:
    contact = collision.find("surface/contact")
    if contact is None:
        return False
    bits = _bits(contact.find("collide_bitmask"), 0xFFFF)
    return is_true(contact.find("collide_without_contact")) or not bits | _bits(contact.find("category_bitmask"), bits)


def _bits(element: Element | None, default: int) -> int:
    found = re.match(r"[+-]?(?:0x[0-9a-f]+|\d+)", text_of(element).lower())
    return default if found is None else int(found[0], 16 if "x" in found[0] else 10) & 0xFFFF
