"""URDF parser: links, joints, masses, shapes and meshes of a robot with all joints held, in its base link's frame."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rover_rl.native.output import logged
from rover_rl.robots.shapes import HERE, Frame, Mass, Shape, combined_mass
from rover_rl.tiny_xml import parse_xml

if TYPE_CHECKING:
    import trimesh

FOUND_PACKAGE = re.compile(r"(file://)?\$\(find\s+([\w-]+)\)")
"""Folder of a ROS package in a file name, as xacro states it."""
_PACKAGE = "package://"
_NAME = re.compile(r"<name>\s*([^<\s]+)\s*</name>")
"""Name of a ROS package in its package.xml."""
_UNIT = re.compile(rb"<unit[^>]*\bmeter\s*=\s*[\"']\s*([0-9.eE+-]+)")
"""Unit that a COLLADA file states, m. trimesh does not apply it."""
_SIZES = {"box": {"size": 3}, "cylinder": {"radius": 1, "length": 1}, "sphere": {"radius": 1}}
"""URDF attributes with the dimensions of a shape, and how many numbers each has, by kind of shape."""
_ROUND = 32
"""Number of points on a circle. A multiple of 4, so that the bounds along the axes are exact."""
_EXPAND = "expand it first: xacro FILE > robot.urdf"
_ROOTS = {"sdf": "an SDF model", "mujoco": "a MuJoCo model", "COLLADA": "a COLLADA mesh"}
"""Other files that describe robots, by their root element."""
_LIGHT = 0.1
"""Largest share of the mass of a robot that is left out because of an expression of xacro."""


def find_mesh(file: str, urdf: Path) -> Path:
    """Returns the path of a mesh file: absolute, beside the URDF, or in the ROS package that holds the URDF."""
    folder = urdf.resolve().parent
    file = FOUND_PACKAGE.sub(rf"{_PACKAGE}\2", file)
    paths = [folder / file.removeprefix("file://")]
    if file.startswith(_PACKAGE):
        package, _, rest = file.removeprefix(_PACKAGE).partition("/")
        parents = (folder, *folder.parents)
        paths = [parent / rest for parent in parents if package in (parent.name, _package_name(parent))]
        paths += [parent / package / rest for parent in parents]
    if found := next((path for path in paths if path.is_file()), None):
        return found
    raise ValueError(f"the mesh {file!r} does not exist; mesh files are relative to the folder of the URDF")


def readable_mesh(file: str, urdf: Path) -> Path:
    """Returns the path of a mesh file that :func:`load_mesh` may read. Raises ``ValueError`` for others."""
    import trimesh

    path = find_mesh(file, urdf)
    if path.suffix.lower().lstrip(".") not in trimesh.available_formats():
        raise ValueError(f"the mesh {file!r} has a format that cannot be read")
    return path


def _package_name(folder: Path) -> str:
    """Name of the ROS package in a folder; of another folder, nothing."""
    try:
        stated = _NAME.search((folder / "package.xml").read_text(errors="replace"))
    except OSError:
        return ""
    return stated[1] if stated else ""


def load_mesh(
    path: Path, scale: Sequence[float] = (1.0, 1.0, 1.0), lost: list[str] | None = None
) -> list[trimesh.Trimesh]:
    """Loads a mesh file in any format of trimesh, such as OBJ and STL, and scales it to meters.

    A file may hold several meshes of different colors. If it names pictures or materials that cannot be read, ``lost``
    gets a sentence.

    Raises:
        ValueError: if the file cannot be read, or has no triangles.
    """
    # Importing it takes a quarter of a second, and robots without meshes do without.
    import trimesh
    from trimesh.resolvers import FilePathResolver

    missing: dict[str, None] = {}

    class Files(FilePathResolver):
        def get(self, name: str) -> bytes:
            try:
                return bytes(super().get(name))
            except OSError:
                missing[name.strip()] = None
                raise

    try:
        with logged("trimesh") as messages:
            meshes = trimesh.load_scene(path, resolver=Files(str(path.parent))).dump()
    # The readers of trimesh raise errors of many kinds for damaged files and missing libraries.
    except Exception as error:
        raise ValueError(f"cannot read the mesh {path}: {error}") from error
    if lost is not None and (missing or messages):
        reason = "they are missing" if missing else messages[0]
        lost.append(f"the mesh {path.name} is read without {', '.join(missing) or 'its materials'}: {reason}")
    meshes = [mesh for mesh in meshes if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    if not meshes:
        raise ValueError(f"the mesh {path} has no triangles")
    stated = _UNIT.search(path.read_bytes()) if path.suffix.lower() == ".dae" else None
    unit = float(stated[1]) if stated else 1.0
    return [mesh.apply_scale([unit * factor for factor in scale]) for mesh in meshes]


class Link(NamedTuple):
    """Rigid part of a robot: its mass about the center of mass, which is at a frame, and its shapes."""

    inertial: tuple[Mass, Frame] | None
    collisions: tuple[Shape, ...]
    visuals: tuple[Shape, ...]


class Joint(NamedTuple):
    """Connection of two links: ``frame`` is that of the child in the parent, and ``axis [3]`` is in this frame.

    ``limits`` are the lowest and highest position, rad or m; ``None`` if the file states none.
    """

    name: str
    kind: str
    parent: str
    child: str
    frame: Frame
    axis: np.ndarray
    limits: tuple[float, float] | None = None


class Piece(NamedTuple):
    """A shape in the base frame, and the points ``[P, 3]`` that it is the hull of, m."""

    link: str
    shape: Shape
    points: np.ndarray


class Description:
    """Contents of a URDF file. Each joint is at zero, or at the limit that is nearest to zero.

    Args:
        path: path of the file.
        turn: rotation of all links about +z, rad.

    Attributes:
        name: name of the robot. Empty if the file states none.
        links, joints: by name.
        base: name of the link that is the child of no joint.
        frames: poses of the links, by name.
        mounts: joint that holds each link, by the name of the link; the base has none.
        lost: what was left out of the file and of its meshes, a sentence each.

    Raises:
        ValueError: if the file is not XML, or not the URDF of one robot.
    """

    def __init__(self, path: Path, turn: float = 0.0) -> None:
        self.path, root = path, _parsed(path)
        self.lost = _leave_out_expressions(root)
        _check_expanded(root)
        self.name = root.get("name", "")
        materials = {each.get("name"): color for each in root.iter("material") if (color := _color(each))}
        self.links: dict[str, Link] = _read(root, "link", partial(_link, materials=materials))
        self.joints: dict[str, Joint] = _read(root, "joint", _joint)
        if not self.links:
            raise ValueError("it has no links")
        self.mounts: dict[str, Joint] = {}
        for joint in self.joints.values():
            if joint.child in self.mounts:
                both = f"joints {self.mounts[joint.child].name!r} and {joint.name!r}"
                raise ValueError(f"link {joint.child!r} is the child of {both}: a URDF has no loops")
            self.mounts[joint.child] = joint
        ends = self.mounts.keys() | {joint.parent for joint in self.joints.values()}
        if unknown := sorted(ends - self.links.keys()):
            raise ValueError(f"a joint names link {unknown[0]!r}, its links are {sorted(self.links)}")
        bases = sorted(self.links.keys() - self.mounts.keys())
        if len(bases) != 1:
            raise ValueError(f"one link must be the child of no joint, it has {bases}")
        self.base = bases[0]
        self.frames = {self.base: Frame(np.zeros(3), Rotation.from_rotvec((0, 0, turn)).as_matrix())}
        for name in self.below(self.base):
            if name in self.mounts:
                joint = self.mounts[name]
                self.frames[name] = self.frames[joint.parent] @ joint.frame @ _held(joint)
        if loop := sorted(self.links.keys() - self.frames.keys()):
            raise ValueError(f"links {loop} hang on one another and not on {self.base!r}: a URDF has no loops")

    def below(self, link: str) -> Iterator[str]:
        """Names a link and all that hangs on it, each after what it hangs on."""
        yield link
        for joint in self.joints.values():
            if joint.parent == link:
                yield from self.below(joint.child)

    def chain(self, link: str) -> list[Joint]:
        """The joints between the base and a link, the base's first."""
        if link not in self.mounts:
            return []
        return [*self.chain(self.mounts[link].parent), self.mounts[link]]

    def axis(self, joint: Joint) -> np.ndarray:
        """Direction of the axis of a joint, ``[3]``; zeros if the file states none."""
        length = float(np.linalg.norm(joint.axis))
        return self.frames[joint.child].rotation @ joint.axis / length if length > 0 else np.zeros(3)

    def mass(self, links: Iterable[str]) -> Mass:
        """Mass of links together. 0 if they have none."""
        stated = [(self.links[name].inertial, self.frames[name]) for name in links]
        return combined_mass([(each[0], frame @ each[1]) for each, frame in stated if each is not None])

    def pieces(self, links: Iterable[str], visual: bool, problems: list[str]) -> list[Piece]:
        """The collision or visual shapes of links. Adds what cannot be read to ``problems``."""
        found = []
        for name in links:
            for shape in self.links[name].visuals if visual else self.links[name].collisions:
                frame = self.frames[name] @ shape.frame
                try:
                    points, lost = _points(shape, self.path)
                except ValueError as error:
                    problems.append(str(error))
                    continue
                self.lost += [sentence for sentence in lost if sentence not in self.lost]
                found.append(Piece(name, shape._replace(frame=frame), frame.position + points @ frame.rotation.T))
        return found


def _parsed(path: Path) -> ET.Element:
    data = path.read_bytes()
    try:
        root = parse_xml(data)
    except ValueError as error:
        reason = f"a xacro file; {_EXPAND}" if b"<xacro:" in data else f"not XML ({error})"
        raise ValueError(f"it is {reason}") from error
    if root.tag != "robot":
        other = _ROOTS.get(root.tag, f"XML with the root element {root.tag!r}")
        raise ValueError(f"it is {other}; a URDF is needed, whose root element is 'robot'")
    return root


def _expression_in(element: ET.Element) -> str:
    """The first value of an element with an expression of xacro, or nothing. Meshes are found by their package."""
    values = (FOUND_PACKAGE.sub("", value) if element.tag == "mesh" else value for value in element.attrib.values())
    return next((value for value in values if "${" in value or "$(" in value), "")


def _check_expanded(root: ET.Element) -> None:
    parts = [root, *(part for tag in ("link", "joint") for each in root.findall(tag) for part in each.iter())]
    macros = (element.tag for element in [*root, *parts] if element.tag.startswith("xacro:"))
    if found := next(macros, "") or next(filter(None, map(_expression_in, parts)), ""):
        raise ValueError(f"it is a xacro file, with {found}; {_EXPAND}")


def _leave_out_expressions(root: ET.Element) -> list[str]:
    """Removes what has an expression of xacro and does not matter for driving, and returns a sentence on each.

    That is: materials, visual shapes, what simulators add to links and joints, and links that are fixed by a joint with
    an expression, such as an IMU, with all that hangs on them, if that is light.
    """
    sentences = []

    def leave_out(parent: ET.Element, part: ET.Element, name: str) -> None:
        if found := next(filter(None, map(_expression_in, part.iter())), ""):
            parent.remove(part)
            sentences.append(f"{name} is left out, as it has the expression {found} of xacro")

    for joint in root.findall("joint"):
        name = joint.get("name", "")
        for part in [*joint]:
            if part.tag not in ("parent", "child", "origin", "axis", "limit"):
                leave_out(joint, part, f"the {part.tag} of joint {name}")
            elif part.tag == "limit":
                for key in ("effort", "velocity"):
                    if "$" in part.get(key, ""):
                        sentences.append(f"the {key} of joint {name} is left out: {part.attrib.pop(key)} of xacro")
        origin = joint.find("origin")
        # What hangs on another link that is left out is gone already.
        if origin is not None and (found := _expression_in(origin)) and joint in root.findall("joint"):
            below, joints = [joint], root.findall("joint")
            for each in below:
                below += [one for one in joints if _end(one, "parent") == _end(each, "child") and one not in below]
            ends = {_end(each, "child") for each in below}
            links = [link for link in root.findall("link") if link.get("name") in ends]
            is_light = _stated_mass(links) <= _LIGHT * _stated_mass(root.findall("link"))
            if is_light and all(each.get("type") == "fixed" for each in below):
                names = ", ".join(sorted(ends))
                sentences.append(f"link {names} is left out, as its pose has the expression {found} of xacro")
                for part in (*below, *links):
                    root.remove(part)
    for link in root.findall("link"):
        for part in [*link]:
            for material in part.findall("material"):
                leave_out(part, material, f"the material of link {link.get('name')}")
            if part.tag not in ("inertial", "collision"):
                leave_out(link, part, f"the {part.tag} of link {link.get('name')}")
    for material in root.findall("material"):
        leave_out(root, material, f"the material {material.get('name')}")
    return sentences


def _end(joint: ET.Element, tag: str) -> str:
    end = joint.find(tag)
    return "" if end is None else end.get("link", "")


def _stated_mass(links: list[ET.Element]) -> float:
    """Mass of links, as far as it is stated in numbers."""
    total = 0.0
    for mass in (link.find("inertial/mass") for link in links):
        with suppress(ValueError):
            total += 0.0 if mass is None else float(mass.get("value", "0"))
    return total


def _read(root: ET.Element, tag: str, read: Callable[[ET.Element], Any]) -> dict[str, Any]:
    """Reads all links or joints, by name."""
    parts: dict[str, Any] = {}
    for element in root.findall(tag):
        name = _attribute(element, "name")
        if name in parts:
            raise ValueError(f"two {tag}s are named {name!r}")
        try:
            parts[name] = read(element)
        except ValueError as error:
            raise ValueError(f"{tag} {name!r}: {error}") from error
    return parts


def _link(element: ET.Element, materials: Mapping[str | None, tuple[float, ...]]) -> Link:
    inertial = element.find("inertial")
    shapes = (_shape(each, {}) for each in element.findall("collision"))
    visuals = (_shape(each, materials) for each in element.findall("visual"))
    return Link(None if inertial is None else _inertial(inertial), tuple(shapes), tuple(visuals))


def _joint(element: ET.Element) -> Joint:
    parent, below = (_attribute(_child(element, end), "link") for end in ("parent", "child"))
    axis, limit, limits = element.find("axis"), element.find("limit"), None
    # The default axis of URDF is x.
    direction = np.array((1.0, 0.0, 0.0) if axis is None else _numbers(axis, "xyz", 3, "1 0 0"))
    if limit is not None and {"lower", "upper"} & set(limit.keys()):
        limits = _numbers(limit, "lower", 1, "0")[0], _numbers(limit, "upper", 1, "0")[0]
    return Joint(
        element.get("name", ""), _attribute(element, "type"), parent, below, _frame(element), direction, limits
    )


def _inertial(element: ET.Element) -> tuple[Mass, Frame]:
    (mass,), moments = _numbers(_child(element, "mass"), "value", 1), _child(element, "inertia")
    xx, xy, xz, yy, yz, zz = (_numbers(moments, f"i{axes}", 1, "0")[0] for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
    return Mass(mass, (0.0, 0.0, 0.0), ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))), _frame(element)


def _shape(element: ET.Element, materials: Mapping[str | None, tuple[float, ...]]) -> Shape:
    geometry = next(iter(_child(element, "geometry")), None)
    if geometry is None:
        raise ValueError(f"a {element.tag} shape has an empty geometry")
    material = element.find("material")
    color = None if material is None else _color(material) or materials.get(material.get("name"))
    if geometry.tag == "mesh":
        sizes, file = _numbers(geometry, "scale", 3, "1 1 1"), _attribute(geometry, "filename")
    else:
        counts, file = _SIZES.get(geometry.tag, {}), ""
        sizes = [size for name, count in counts.items() for size in _numbers(geometry, name, count)]
    return Shape(geometry.tag, _frame(element), tuple(sizes), file, color)


def _color(material: ET.Element) -> tuple[float, ...] | None:
    """The color of a material without its opacity. ``None`` if it only refers to another by name."""
    color = material.find("color")
    return None if color is None else tuple(_numbers(color, "rgba", 4)[:3])


def _frame(element: ET.Element) -> Frame:
    origin = element.find("origin")
    if origin is None:
        return HERE
    # Successive rotations about the fixed axes x, y and z.
    turn = Rotation.from_euler("xyz", _numbers(origin, "rpy", 3, "0 0 0"))
    return Frame(np.array(_numbers(origin, "xyz", 3, "0 0 0")), turn.as_matrix())


def _child(element: ET.Element, tag: str) -> ET.Element:
    if (part := element.find(tag)) is None:
        raise ValueError(f"{element.tag} has no {tag}")
    return part


def _attribute(element: ET.Element, name: str, default: str | None = None) -> str:
    if (value := element.get(name, default)) is None:
        raise ValueError(f"{element.tag} has no {name}")
    return value


def _numbers(element: ET.Element, name: str, count: int, default: str | None = None) -> list[float]:
    """The ``count`` finite numbers of an attribute."""
    text = _attribute(element, name, default)
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        allowed = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ValueError(f"{name} of {element.tag} must be {allowed}, got {text!r}")
    return numbers


def _held(joint: Joint) -> Frame:
    """Motion of a joint that is held at the position nearest to zero."""
    low, high = joint.limits or (0.0, 0.0)
    if joint.kind not in ("revolute", "prismatic") or not low <= high:
        return HERE
    step = min(max(0.0, low), high) * joint.axis / max(float(np.linalg.norm(joint.axis)), 1e-12)
    if joint.kind == "prismatic":
        return Frame(step, np.eye(3))
    return Frame(np.zeros(3), Rotation.from_rotvec(step).as_matrix())


def _points(shape: Shape, urdf: Path) -> tuple[np.ndarray, tuple[str, ...]]:
    """Points in the frame of a shape, whose hull is that of the shape, and what its mesh file lacks."""
    if shape.kind == "box":
        corners = np.stack(np.meshgrid((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5)), -1).reshape(-1, 3)
        return corners * shape.sizes, ()
    if shape.kind == "mesh":
        path = find_mesh(shape.file, urdf)
        return _mesh_points(path, shape.sizes, path.stat().st_mtime_ns)
    angles = np.arange(_ROUND) * 2 * math.pi / _ROUND
    circle = np.column_stack((np.cos(angles), np.sin(angles), np.zeros(_ROUND)))
    if shape.kind == "cylinder":
        radius, length = shape.sizes
        return np.concatenate([radius * circle + (0, 0, side * length / 2) for side in (-1, 1)]), ()
    if shape.kind == "sphere":
        return shape.sizes[0] * np.concatenate([np.roll(circle, turn, 1) for turn in range(3)]), ()
    raise ValueError(f"a shape is a {shape.kind}; use a box, cylinder, sphere or mesh")


@lru_cache(maxsize=256)
def _mesh_points(path: Path, scale: tuple[float, ...], modified: int) -> tuple[np.ndarray, tuple[str, ...]]:
    """``modified`` is the time of the file's last change."""
    lost: list[str] = []
    return np.concatenate([np.asarray(mesh.vertices) for mesh in load_mesh(path, scale, lost)]), tuple(lost)
