"""SDF worlds and models of Gazebo Classic and Gazebo Sim."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from rover_rl.option_names import written
from rover_rl.sims.worlds.files.contents import Contents, listed
from rover_rl.sims.worlds.files.frames import MODEL, WORLD, Scope, pose_of, to_pose
from rover_rl.sims.worlds.files.locate import Locator
from rover_rl.sims.worlds.files.options import ImportOptions
from rover_rl.sims.worlds.files.shapes import ShapeReader
from rover_rl.sims.worlds.files.xml_tree import is_true, numbers, read_xml, text_of
from rover_rl.sims.worlds.movers import Mover, Person, Waypoints

MAX_MODELS = 3_000
"""Largest number of models of a world, includes counted each time."""
MOVING = re.compile(
    "velocity|joint(?!.?state)|traject|drive|mov(?:e|ing)|actor|animat|convey|patrol|elevator|steer", re.I
)
"""What is in the name of a plugin that moves its model: VelocityControl, JointController, TrajectoryFollower."""
MAX_NESTING = 20


def read_sdf(path: Path, options: ImportOptions) -> Contents:
    """Reads an SDF file with a world or a model."""
    root = _root(path)
    world = root.find("world")
    top = root if world is None else world
    own, given = path.name.partition(".")[0], top.get("name", "")
    # Gazebo's own template is called "default", and so are most worlds that were saved from it.
    contents = Contents(own if given in ("", "default") else given)
    locator = Locator(path, options.model_paths)
    reader = _Reader(contents, locator, options)
    reader.read(top, path)
    missing = list(dict.fromkeys(locator.missing))
    if missing and options.missing == "error":
        raise ValueError(
            f"{path} needs what is not here: {listed(missing, 50)}; name their folders with {written('model_paths')}, "
            f"download them, or leave them out with {written('missing', 'skip')}"
        )
    if missing:
        contents.left_out.append(f"left out, as {written('missing', 'skip')} says: {listed(missing, 50)}")
    reader.tell()
    if locator.elsewhere:
        contents.notes.append(f"files found by their names: {listed(locator.elsewhere)}")
    return contents


def _root(path: Path) -> Element:
    """Returns the root of an SDF file of a version that is supported."""
    root = read_xml(path)
    if root.tag != "sdf":
        raise ValueError(f"{path} is not SDF: its root is <{root.tag[:40]}>, not <sdf>")
    version = re.fullmatch(r"1\.(\d+)(\.\d+)?", root.get("version", "").strip())
    if not version or not 4 <= int(version[1]) <= 12:
        raise ValueError(f"{path} has the SDF version {root.get('version')!r}; 1.4 to 1.12 are supported")
    return root


@dataclass(frozen=True)
class _Place:
    """Where a model is read: its file, and the world pose ``[4, 4]`` and the frames of its parent.

    ``name`` has the parents' names, with slashes. ``static`` tells whether a parent is static. ``files`` are those on
    the way, to find circles, and ``depth`` is the number of models and includes on the way.
    """

    file: Path
    transform: np.ndarray
    scope: Scope
    name: str = ""
    static: bool = False
    files: tuple[Path, ...] = ()
    depth: int = 0


class _Reader:
    """Walks through a world and collects shapes and actors."""

    def __init__(self, contents: Contents, locator: Locator, options: ImportOptions) -> None:
        self._contents, self._locator, self._options = contents, locator, options
        self._shapes = ShapeReader(contents, locator)
        self._moving: list[str] = []
        self._driven: list[str] = []
        self._jointed: list[str] = []
        self._shown: list[str] = []
        self._models = 0
        self._roots: dict[Path, Element] = {}

    def read(self, top: Element, path: Path) -> None:
        """Reads the models, includes and actors of a world, or of a file without a world."""
        self._read_children(top, _Place(path, np.eye(4), Scope.of(top, "the world"), files=(path.resolve(),)))
        if top.find("population") is not None:
            self._contents.left_out.append("a <population> is random in Gazebo, and left out")

    def tell(self) -> None:
        """Adds sentences on what is not as in Gazebo to the contents."""
        contents = self._contents
        for names, sentence in (
            (self._moving, "models that are not static do not move"),
            (self._driven, "models that plugins move in Gazebo stand still"),
            (self._jointed, "models that are not static and have joints are left out"),
        ):
            if names:
                contents.left_out.append(f"{sentence}: {listed(names)}")
        if self._shown:
            contents.notes.append(f"links without collision geometry have their visual one: {listed(self._shown)}")

    def _read_children(self, parent: Element, place: _Place) -> None:
        """Reads the models of a world or a model: first all frames, which may be relative to one another."""
        state = _state_poses(parent)
        found: list[tuple[Element, Path, Element]] = []
        for element in parent:
            if element.tag == "include":
                included = self._included(element, place)
                if included is not None:
                    found.append(included)
            elif element.tag in ("model", "actor"):
                found.append((element, place.file, Element("include")))
        entries = [self._enter(element, file, include, place, state) for element, file, include in found]
        for (element, file, include), (name, scope) in zip(found, entries, strict=True):
            if element.tag == "actor":
                self._actor(element, place.transform @ place.scope.pose(name), name)
                continue
            # What the include says about its model counts.
            says = element if include.find("static") is None else include
            inner = _Place(
                file,
                place.transform @ place.scope.pose(name),
                scope,
                f"{place.name}/{name}".lstrip("/"),
                place.static or is_true(says.find("static")),
                (*place.files, file.resolve()),
                place.depth + 1,
            )
            self._model(element, inner)

    def _enter(
        self, element: Element, file: Path, include: Element, place: _Place, state: dict[str, np.ndarray]
    ) -> tuple[str, Scope]:
        """Adds the frame of a model to its parent's, and returns its name there and its own frames."""
        name = text_of(include.find("name")) or element.get("name", "")
        scope = Scope.of(element, f"the model {name!r}") if element.tag == "model" else Scope(name)
        source = element if include.find("pose") is None else include
        transform, base = pose_of(source, f"{element.tag} {name!r} in {file.name}")
        if name in state:
            transform, base = state[name], ""
        placement = text_of(include.find("placement_frame")) or element.get("placement_frame", "")
        if placement:
            transform = transform @ np.linalg.inv(scope.pose(placement))
        # Gazebo gives a second model of the same name another one.
        while name in place.scope.frames:
            name += "_"
        place.scope.frames[name] = (transform, base)
        place.scope.children[name] = scope
        if include.get("merge", "").lower() in ("1", "true"):
            place.scope.merged.append((name, scope))
        return name, scope

    def _model(self, element: Element, place: _Place) -> None:
        self._models += 1
        if self._models > MAX_MODELS:
            raise ValueError(f"the world has more than {MAX_MODELS:,} models")
        if place.depth > MAX_NESTING:
            raise ValueError(f"{place.file} has models within one another more than {MAX_NESTING} deep")
        movers = [name for plugin in element.findall("plugin") if (name := _mover(plugin))]
        if movers:
            self._driven.append(f"{place.name} ({', '.join(movers)})")
        if not place.static and not is_true(element.find("static")):
            if _has_movable_joints(element):
                self._jointed.append(place.name)
                return
            if element.findall("link"):
                self._moving.append(place.name)
        self._read_children(element, place)
        for link in element.findall("link"):
            self._link(link, place)

    def _link(self, link: Element, place: _Place) -> None:
        name = f"{place.name}/{link.get('name', '')}"
        transform = place.transform @ place.scope.pose(link.get("name", ""))
        parts = link.findall("collision")
        if not parts and self._options.visuals:
            parts = link.findall("visual")
            self._shown += [name] if parts else []
        for part in parts:
            pose, base = pose_of(part, f"{part.tag} {part.get('name', '')!r} of {name}")
            # Without relative_to, a pose is relative to the link.
            at = transform if not base else place.transform @ place.scope.pose(base if base != WORLD else MODEL)
            geometry = part.find("geometry")
            if geometry is not None:
                self._shapes.add(geometry, at @ pose, f"{name}/{part.get('name', '')}", place.file.parent)

    def _actor(self, actor: Element, transform: np.ndarray, name: str) -> None:
        """Adds an actor as a person on the ground. Its waypoints are relative to its pose."""
        script = actor.find("script")
        script = Element("script") if script is None else script
        timed = [
            (float(numbers(waypoint.find("time"), 1, None, f"a waypoint's time of {name!r}")[0]), waypoint)
            for waypoint in script.findall("trajectory/waypoint")
        ]
        keys = []
        for time, waypoint in sorted(timed, key=lambda pair: pair[0]):
            x, y, _, _, _, yaw = to_pose(transform @ pose_of(waypoint, f"a waypoint of {name!r}")[0])
            keys.append((time, x, y, yaw))
        loop, auto = (flag is None or is_true(flag) for flag in map(script.find, ("loop", "auto_start")))
        delay = numbers(script.find("delay_start"), 1, (0,), f"delay_start of {name!r}")
        x, y, _, _, _, yaw = to_pose(transform)
        # An actor that does not start by itself stands at its first waypoint.
        keys = (keys if auto else keys[:1]) or [(0.0, x, y, yaw)]
        loops = loop and keys[-1][0] > 0
        self._contents.movers.append(
            Mover(Waypoints(keys, "loop" if loops else "once", delay=float(delay[0])), Person(), name)
        )

    def _included(self, include: Element, place: _Place) -> tuple[Element, Path, Element] | None:
        """Returns an included model or actor, its file, and the ``<include>``; ``None`` if it is missing or a light."""
        uri = text_of(include.find("uri"))
        if not uri:
            raise ValueError(f"an <include> in {place.file} has no uri")
        path = self._locator.file(uri, place.file.parent, _model_file)
        if path is None:
            return None
        if path.resolve() in place.files:
            raise ValueError(f"{path} includes itself")
        if path not in self._roots:
            self._roots[path] = _root(path)
        found = [child for child in self._roots[path] if child.tag in ("model", "actor")]
        return (found[0], path, include) if found else None


def _mover(plugin: Element) -> str:
    """Returns the name of a plugin that moves its model, empty for another plugin."""
    name = plugin.get("name", "") or plugin.get("filename", "")
    moves = any(MOVING.search(text) for text in (name, plugin.get("filename", "")))
    return name.rpartition("::")[2] if moves else ""


def _has_movable_joints(model: Element) -> bool:
    """Returns whether a model, or one in it, has a joint that is not fixed."""
    joints = any(joint.get("type", "fixed") != "fixed" for joint in model.findall("joint"))
    return joints or any(map(_has_movable_joints, model.findall("model")))


def _model_file(folder: Path) -> Path | None:
    """Returns the SDF file of a model's folder: that of the newest version in ``model.config``, else ``model.sdf``."""
    config = next((folder / name for name in ("model.config", "manifest.xml") if (folder / name).is_file()), None)
    names = ["model.sdf"]
    if config is not None:
        listed_files = [(_version(sdf.get("version", "0")), text_of(sdf)) for sdf in read_xml(config).findall("sdf")]
        names = [name for _, name in sorted(listed_files, reverse=True)] + names
    for name in names:
        path = folder / name
        if Path(name).name == name and path.is_file():
            return path
    return None


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", text))


def _state_poses(world: Element) -> dict[str, np.ndarray]:
    """Returns the poses of models in the saved state of a Gazebo Classic world, which count instead of their own."""
    state = world.find("state") if world.tag == "world" else None
    models = [] if state is None else [model for model in state.findall("model") if model.find("pose") is not None]
    return {model.get("name", ""): pose_of(model, f"the state of {model.get('name', '')!r}")[0] for model in models}
