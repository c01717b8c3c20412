"""SDF worlds and models of Gazebo Classic and Gazebo Sim."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import unquote
from xml.etree.ElementTree import Element

import numpy as np

from rover_rl.option_names import written
from rover_rl.tiny_xml import is_true, numbers, parse_xml, read_xml, text_of
from rover_rl.worlds.files.contents import Contents, Piece, listed
from rover_rl.worlds.files.frames import MODEL, WORLD, Scope, pose_of, to_pose
from rover_rl.worlds.files.locate import Locator
from rover_rl.worlds.files.options import ImportOptions
from rover_rl.worlds.files.shapes import ShapeReader
from rover_rl.worlds.movers import Mover, Person, Waypoints

MOVING = re.compile(
    "velocity|joint(?!.?state)|traject|drive|mov(?:e|ing)|actor|animat|convey|patrol|elevator|steer", re.I
)
"""What is in the name of a plugin that moves its model: VelocityControl, JointController, TrajectoryFollower."""
STRAY = 1_000.0
"""Distance from the origin beyond which a piece is left out that is ten times as far as all others, m."""
GROUND_PLANE = (
    b"<model name='ground_plane'><static>1</static><link name='link'><collision name='collision'>"
    b"<geometry><plane><normal>0 0 1</normal><size>100 100</size></plane></geometry></collision></link></model>"
)
"""The model ``ground_plane`` of Gazebo."""


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
    if contents.wrong and not (contents.pieces or contents.grids or contents.movers):
        raise contents.wrong[0]
    strays = _strays(contents.pieces)
    if strays:
        contents.pieces = [piece for piece in contents.pieces if all(piece is not stray for stray in strays)]
        names = listed(stray.name for stray in strays)
        contents.left_out.append(f"left out, as they are more than {STRAY / 1000:g} km from all others: {names}")
    reader.tell()
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


@dataclass(frozen=True)
class _Place:
    """Where a model is read: its file, and the world pose ``[4, 4]`` and the frames of its parent.

    ``name`` has the parents' names, with slashes. ``state`` is what a saved world says of it in place of its own file.
    ``static`` tells whether a parent is static. ``files`` are those on the way, to find circles.
    """

    file: Path
    transform: np.ndarray
    scope: Scope
    name: str = ""
    state: Element = field(default_factory=lambda: Element("state"))
    static: bool = False
    files: tuple[Path, ...] = ()


class _Reader:
    """Walks through a world and collects shapes and actors."""

    def __init__(self, contents: Contents, locator: Locator, options: ImportOptions) -> None:
        self._contents, self._locator, self._options = contents, locator, options
        self._shapes = ShapeReader(contents, locator)
        self._moving: list[str] = []
        self._driven: list[str] = []
        self._jointed: list[str] = []
        self._off: list[str] = []
        self._shown: list[str] = []
        self._roots: dict[Path, Element] = {}

    def read(self, top: Element, path: Path) -> None:
        """Reads the models, includes and actors of a world, or of a file without a world."""
        state = top.find("state")
        state = Element("state") if state is None else state
        top.extend(state.findall("insertions/model"))
        place = _Place(path, np.eye(4), Scope.of(top, "the world"), state=state, files=(path.resolve(),))
        self._read_children(top, place)
        if top.find("population") is not None:
            self._contents.left_out.append("a <population> is random in Gazebo, and left out")

    def tell(self) -> None:
        """Adds sentences on what is not as in Gazebo to the contents."""
        contents = self._contents
        for names, sentence in (
            (self._moving, "models that are not static do not move"),
            (self._driven, "models that plugins move in Gazebo stand still"),
            (self._jointed, "models that are not static and have joints are left out"),
            (self._off, "collisions that stop nothing are left out"),
        ):
            if names:
                contents.left_out.append(f"{sentence}: {listed(names)}")
        if contents.wrong:
            contents.left_out.append(f"left out, as they are wrong: {listed(map(str, contents.wrong), 20)}")
        if self._shown:
            contents.notes.append(f"links without collision geometry have their visual one: {listed(self._shown)}")

    def _read_children(self, parent: Element, place: _Place) -> None:
        deleted = {text_of(name) for name in place.state.findall("deletions/name")}
        found: list[tuple[Element, Path, Element]] = []
        for element in parent:
            with self._contents.leaving_out():
                if element.tag == "include":
                    found += self._included(element, place)
                elif element.tag in ("model", "actor"):
                    found.append((element, place.file, Element("include")))
        entries = [self._enter(element, file, include, place) for element, file, include in found]
        for (element, file, include), (name, scope) in zip(found, entries, strict=True):
            if name in deleted:
                continue
            transform = None
            with self._contents.leaving_out():
                transform = place.transform @ place.scope.pose(name)
                if element.tag == "actor":
                    self._actor(element, transform, name)
            if transform is None or element.tag == "actor":
                continue
            # What the include says about its model counts.
            says = element if include.find("static") is None else include
            inner = _Place(
                file,
                transform,
                scope,
                f"{place.name}/{name}".lstrip("/"),
                _named(place.state, "model", name),
                place.static or is_true(says.find("static")),
                (*place.files, file.resolve()),
            )
            self._model(element, inner)

    def _enter(self, element: Element, file: Path, include: Element, place: _Place) -> tuple[str, Scope]:
        name = text_of(include.find("name")) or element.get("name", "")
        scope = Scope.of(element, f"the model {name!r}") if element.tag == "model" else Scope(name)
        saved = _named(place.state, "model", name)

        def pose() -> tuple[np.ndarray, str]:
            if saved.find("pose") is not None:
                # A saved state has poses in the world.
                return np.linalg.inv(place.transform) @ pose_of(saved, f"the state of {name!r}")[0], ""
            source = element if include.find("pose") is None else include
            transform, base = pose_of(source, f"{element.tag} {name!r} in {file.name}")
            placement = text_of(include.find("placement_frame")) or element.get("placement_frame", "")
            return transform @ np.linalg.inv(scope.pose(placement)), base

        # Gazebo gives a second model of the same name another one.
        while name in place.scope.frames:
            name += "_"
        place.scope.frames[name] = pose
        place.scope.children[name] = scope
        if include.get("merge", "").lower() in ("1", "true"):
            place.scope.merged.append((name, scope))
        return name, scope

    def _model(self, element: Element, place: _Place) -> None:
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
        parts = link.findall("collision")
        if not parts and self._options.visuals:
            parts = link.findall("visual")
            self._shown += [name] if parts else []
        for part in parts:
            own = f"{name}/{part.get('name', '')}"
            geometry = part.find("geometry")
            with self._contents.leaving_out(own):
                if geometry is not None and not _is_off(part):
                    self._shapes.add(geometry, self._placed(part, link, place), own, place.file.parent)
                elif geometry is not None:
                    self._off.append(own)

    def _placed(self, part: Element, link: Element, place: _Place) -> np.ndarray:
        name = link.get("name", "")
        pose, base = pose_of(part, f"{part.tag} {part.get('name', '')!r} of {place.name}/{name}")
        saved = _named(place.state, "link", name)
        if base:
            # Without relative_to, a pose is relative to the link.
            at = place.transform @ place.scope.pose(base if base != WORLD else MODEL)
        elif saved.find("pose") is not None:
            at = pose_of(saved, f"the state of {place.name}/{name}")[0]
        else:
            at = place.transform @ place.scope.pose(name)
        scale = numbers(place.state.find("scale"), 3, (1, 1, 1), f"the scale in the state of {place.name}")
        # Gazebo Classic ignores scales that are negative.
        return at @ pose @ np.diag((*(scale if (scale > 0).all() else (1, 1, 1)), 1))

    def _actor(self, actor: Element, transform: np.ndarray, name: str) -> None:
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

    def _included(self, include: Element, place: _Place) -> list[tuple[Element, Path, Element]]:
        uri = text_of(include.find("uri"))
        if not uri:
            raise ValueError(f"an <include> in {place.file} has no uri")
        path = self._locator.file(uri, place.file.parent, _model_file)
        if path is None:
            return self._of_gazebo(uri, include, place)
        if path.resolve() in place.files:
            raise ValueError(f"{path} includes itself")
        if path not in self._roots:
            self._roots[path] = _root(path)
        found = [child for child in self._roots[path] if child.tag in ("model", "actor")]
        return [(found[0], path, include)] if found else []

    def _of_gazebo(self, uri: str, include: Element, place: _Place) -> list[tuple[Element, Path, Element]]:
        name = re.sub(r"(/tip|/\d+|/model.sdf)?/*$", "", unquote(uri)).rpartition("/")[2].lower().replace(" ", "_")
        if name not in ("sun", "ground_plane"):
            return []
        self._locator.missing.pop()
        return [] if name == "sun" else [(parse_xml(GROUND_PLANE), place.file, include)]


def _strays(pieces: list[Piece]) -> list[Piece]:
    away = sorted(((float(np.linalg.norm(piece.vertices, axis=1).min()), n) for n, piece in enumerate(pieces)))
    for k in range((len(away) + 1) // 2, len(away)):
        if away[k][0] > max(STRAY, 10 * away[k - 1][0]):
            return [pieces[n] for _, n in away[k:]]
    return []


def _mover(plugin: Element) -> str:
    name = plugin.get("name", "") or plugin.get("filename", "")
    moves = any(MOVING.search(text) for text in (name, plugin.get("filename", "")))
    return name.rpartition("::")[2] if moves else ""


def _has_movable_joints(model: Element) -> bool:
    joints = any(joint.get("type", "fixed") != "fixed" for joint in model.findall("joint"))
    return joints or any(map(_has_movable_joints, model.findall("model")))


def _model_file(folder: Path) -> Path | None:
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


def _named(parent: Element, tag: str, name: str) -> Element:
    return next((child for child in parent.findall(tag) if child.get("name") == name), Element(tag))


def _is_off(collision: Element) -> bool:
    contact = collision.find("surface/contact")
    if contact is None:
        return False
    if is_true(contact.find("collide_without_contact")):
        return True
    bits = _bits(contact.find("collide_bitmask"), 0xFFFF)
    return not bits | _bits(contact.find("category_bitmask"), bits)


def _bits(element: Element | None, default: int) -> int:
    found = re.match(r"[+-]?(?:0x[0-9a-f]+|\d+)", text_of(element).lower())
    return default if found is None else int(found[0], 16 if "x" in found[0] else 10) & 0xFFFF
