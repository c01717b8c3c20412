"""Triangle meshes from files, and as arrays.

Arrays are ``vertices [V, 3]`` in meters, and ``faces [F, 3]``, counter-clockwise from outside. Files are read node by
node, with their transforms, in meters, with z up.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.spatial import ConvexHull, QhullError
from trimesh.graph import connected_components, face_adjacency, is_watertight
from trimesh.resolvers import FilePathResolver
from trimesh.sample import sample_surface

from rover_rl.native.output import logged
from rover_rl.tiny_xml import read_xml, text_of
from rover_rl.worlds.files.contents import Piece
from rover_rl.worlds.files.options import Up, optional

MERGE = 1e-5
"""Vertices of a mesh that are closer than this are one, m."""
COVERED = 1e-3
"""Distance from other triangles up to which a triangle is a double of them, m."""
MAX_ROUNDS = 200
LEAST_SHARE = 0.002
"""Share of the vertices that a round of the simplification must remove, or else it is the last one."""
FLIP = 0.3
"""Least cosine of the angle by which a merge of vertices may turn a triangle."""
MAX_FACES = 5_000_000
_TO_Z_UP = {
    "x": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "z": np.eye(3),
}
"""Rotations that turn the axis that points up into z. COLLADA 1.4.1 defines the two other axes of each."""
_WHITE_PIXEL = b"P6 1 1 255 \xff\xff\xff"
"""A picture in the format PPM."""


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns the normals of triangles, twice as long as the triangles are large: ``[F, 3]``."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def is_closed(faces: np.ndarray) -> bool:
    """Returns whether every edge belongs to two triangles, which run along it in opposite directions."""
    return len(faces) > 0 and all(is_watertight(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)))


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Returns the volume of a closed mesh, m^3: negative if its normals point inward."""
    a, b, c = (vertices[faces[:, k]] - vertices[faces[0, 0]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def convex_hull(points: np.ndarray) -> ConvexHull | None:
    """Returns the convex hull of points. ``None`` if they lie in one plane, or on a line in the plane."""
    try:
        return ConvexHull(points)
    except (QhullError, ValueError):
        return None


def hull_volume(points: np.ndarray) -> float:
    """Returns the volume of the hull of points ``[P, 3]``, m^3, or the area of that of points ``[P, 2]``, m^2."""
    hull = convex_hull(points)
    return 0.0 if hull is None else float(hull.volume)


def split(piece: Piece) -> list[Piece]:
    """Splits a mesh into its connected parts, after merging equal vertices and dropping triangles without area.

    Two triangles are connected if they share an edge with no third one: bodies that touch stay apart. The outer and
    the inner surface of a hollow solid are one part. The parts of copies of a mesh have the same points: what a pose
    stretches is stretched, and their pose is a rotation, or a rotation and a mirror image.
    """
    if piece.faces is None:
        return [piece]
    points, pose = _unstretched(piece)
    _, first, same = np.unique(np.rint(points / MERGE).astype(np.int64), axis=0, return_index=True, return_inverse=True)
    vertices, faces = points[first], same.reshape(-1)[piece.faces]
    faces = faces[np.linalg.norm(face_normals(vertices, faces), axis=1) > 1e-12]
    # A triangle that occurs twice with the same corners would hide holes.
    _, keep = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(keep)]
    parts = []
    for group in _with_cavities(vertices, faces) if len(faces) else ():
        used, renumbered = np.unique(faces[group], return_inverse=True)
        parts.append(Piece(piece.name, vertices[used], renumbered.reshape(-1, 3), pose))
    return parts


def _unstretched(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    linear = piece.pose[:3, :3]
    squares, axes = np.linalg.eigh(linear.T @ linear)
    if squares[0] <= 1e-12 * squares[2]:
        return piece.vertices, np.eye(4)
    # Rounded, so that copies whose turns differ give the same points, to the last bit.
    unit = 10.0 ** np.floor(np.log10(np.sqrt(squares[2])))
    stretch = ((axes * np.sqrt(squares)) @ axes.T / unit).round(9) * unit
    pose = piece.pose.copy()
    pose[:3, :3] = linear @ np.linalg.inv(stretch)
    return piece.points @ stretch, pose


def _connected(faces: np.ndarray, pairs: np.ndarray) -> list[np.ndarray]:
    return [np.sort(group) for group in connected_components(pairs, min_len=1, nodes=np.arange(len(faces)))]


def _with_cavities(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Returns the connected parts as indices of triangles, with the inner surfaces of solids in their outer ones."""
    groups = _connected(faces, face_adjacency(faces))
    volumes = [signed_volume(vertices, faces[group]) for group in groups]
    inner = [k for k, volume in enumerate(volumes) if volume < 0 and is_closed(faces[groups[k]])]
    outer = [k for k, volume in enumerate(volumes) if inner and volume > 0 and is_closed(faces[groups[k]])]
    joined = dict(enumerate(groups))
    for k in inner:
        point = vertices[faces[groups[k][0], 0]]
        around = [j for j in outer if volumes[j] > -volumes[k] and _encloses(vertices[faces[groups[j]]], point)]
        if around:
            nearest = min(around, key=lambda j: volumes[j])
            joined[nearest] = np.concatenate((joined[nearest], joined.pop(k)))
    return [*joined.values()]


def _encloses(triangles: np.ndarray, point: np.ndarray) -> bool:
    """Returns whether a point is inside a closed surface ``[F, 3, 3]``: by the solid angle that it fills."""
    a, b, c = (triangles - point).swapaxes(0, 1)
    na, nb, nc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    over = (a * np.cross(b, c)).sum(1)
    under = na * nb * nc + (a * b).sum(1) * nc + (b * c).sum(1) * na + (c * a).sum(1) * nb
    return float(np.arctan2(over, under).sum()) > np.pi


def flat_patches(vertices: np.ndarray, faces: np.ndarray, sine: float, most: int) -> Iterator[np.ndarray]:
    """Yields groups of triangles that lie side by side in one plane, as indices, without those that others cover.

    Triangles connect if the sine of the angle between them is less than ``sine``. Their normals may point to either
    side. The back of a sheet with two sides is covered by its front. The largest group comes first; of more than twice
    ``most``, none is compared with others.
    """
    normals = face_normals(vertices, faces)
    areas = np.linalg.norm(normals, axis=1)
    normals = normals / areas[:, None]
    pairs, edges = face_adjacency(faces, return_edges=True)
    start, along = vertices[edges[:, 0]], vertices[edges[:, 1]] - vertices[edges[:, 0]]
    # From the edge that two triangles share, they must extend to opposite sides.
    one, other = (np.cross(along, vertices[faces[side]].mean(1) - start) for side in pairs.T)
    flat = np.abs((normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(1)) > 1 - sine**2
    groups = _connected(faces, pairs[flat & ((one * other).sum(1) < 0)])
    kept = np.empty(0, dtype=int)
    for group in sorted(groups, key=lambda group: -areas[group].sum()):
        samples = surface_samples(vertices, faces[group])
        heights = (vertices[faces[kept, 0]] - samples[0]) @ normals[group[0]]
        same = kept[(np.abs(normals[kept] @ normals[group[0]]) > 1 - sine**2) & (np.abs(heights) < COVERED)]
        compared = len(same) and len(groups) <= 2 * most
        if not compared or distances(samples, vertices, faces[same]).max() > COVERED:
            kept = np.append(kept, group)
            yield group


def surface_samples(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns seven points of each triangle, beside its corners: ``[7 F, 3]``."""
    shares = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=float)
    return np.einsum("sk,fkd->fsd", shares / shares.sum(1, keepdims=True), vertices[faces]).reshape(-1, 3)


def random_points(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples points on triangles, in proportion to their areas: ``[count, 3]``, and their triangles ``[count]``."""
    return sample_surface(trimesh.Trimesh(vertices, faces, process=False), count, seed=0)


def distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns the distances of points from the nearest triangle: ``[P]``, m."""
    from rover_rl.worlds.ground_kernels import measure_distances

    return _measured(measure_distances, points, vertices, faces)


def ray_distances(
    points: np.ndarray, direction: Sequence[float] | np.ndarray, vertices: np.ndarray, faces: np.ndarray
) -> np.ndarray:
    """Returns the distances of triangles from points along a direction: ``[P]``, m, NaN where there is none."""
    from rover_rl.worlds.ground_kernels import measure_rays

    return _measured(measure_rays, points, vertices, faces, tuple(direction))


def _measured(kernel: Any, points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, *inputs: Any) -> np.ndarray:
    # Importing NVIDIA Warp takes half a second.
    from rover_rl.native.warp import wp

    found = np.full(len(points), np.nan, np.float32)
    if len(faces):
        # Single precision is enough near the origin.
        middle = vertices[faces].mean((0, 1))
        corners, starts = (wp.array(part - middle, dtype=wp.vec3, device="cpu") for part in (vertices, points))
        mesh = wp.Mesh(corners, wp.array(faces.ravel(), dtype=int, device="cpu"))
        wp.launch(kernel, len(points), [mesh.id, starts, found, *inputs], device="cpu")
    return found.astype(float)


def merge_triangles(points: np.ndarray, triangles: np.ndarray, slack: float = 0.0) -> list[list[int]]:
    """Merges triangles ``[T, 3]`` of ``points [P, 2]`` into convex polygons, greedily, as indices of the points.

    Some of the points may lie on the edges of their polygon, or in it, at most ``slack`` from the edges.
    """

    def area_of(corners: set[int]) -> float:
        return hull_volume(points[list(corners)])

    def pocket(corners: set[int]) -> float:
        inside = points[list(corners)]
        planes = ConvexHull(inside).equations
        return float((-(inside @ planes[:, :2].T + planes[:, 2])).min(1).max())

    whole = {*triangles.ravel().tolist()}
    left = {k: ({*triangle}, area_of({*triangle})) for k, triangle in enumerate(triangles.tolist())}
    if area_of(whole) <= sum(area for _, area in left.values()) * (1 + 1e-6):
        return [[*whole]]
    polygons = []
    while left:
        _, (polygon, area) = left.popitem()
        grown = True
        while grown:
            grown = False
            for other, (corners, more) in list(left.items()):
                if len(polygon & corners) < 2:
                    continue
                union = polygon | corners
                union_area = area_of(union)
                if union_area <= (area + more) * (1 + 1e-6) or (slack and pocket(union) <= slack):
                    polygon, area, grown = union, union_area, True
                    del left[other]
        polygons.append([*polygon])
    return polygons


def simplify(vertices: np.ndarray, faces: np.ndarray, error: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns a mesh with fewer triangles by edge collapses (Garland and Heckbert, 1997, doi:10.1145/258734.258849).

    In each round, vertices that are far from one another move to a neighbor at once. A closed mesh stays closed.
    ``error`` is the largest distance of a vertex from the planes of the triangles that it stands for, their root mean
    square, m.
    """
    normals = face_normals(vertices, faces)
    # Weighted by the area, as the length of the normals is twice that.
    planes = np.column_stack((normals, -(normals * vertices[faces[:, 0]]).sum(1)))
    planes /= np.sqrt(np.linalg.norm(normals, axis=1, keepdims=True))
    quadrics = np.zeros((len(vertices), 4, 4))
    np.add.at(quadrics, faces, (planes[:, :, None] * planes[:, None, :])[:, None])
    fixed = np.zeros(len(vertices), dtype=bool)
    edges, counts = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)), axis=0, return_counts=True)
    fixed[edges[counts != 2]] = True
    rng = np.random.default_rng(0)
    for _ in range(MAX_ROUNDS):
        moves = _moves(vertices, faces, quadrics, fixed, error, rng)
        np.add.at(quadrics, moves[:, 1], quadrics[moves[:, 0]])
        target = np.arange(len(vertices))
        target[moves[:, 0]] = moves[:, 1]
        faces = target[faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(1)]
        if len(moves) <= LEAST_SHARE * len(np.unique(faces)):
            break
    used, renumbered = np.unique(faces, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3)


def _moves(
    vertices: np.ndarray,
    faces: np.ndarray,
    quadrics: np.ndarray,
    fixed: np.ndarray,
    error: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Returns which vertices move to which neighbors: ``[M, 2]``. None of them has a neighbor in common."""
    count = len(vertices)
    start, end = np.concatenate([faces[:, [k, (k + step) % 3]] for k in range(3) for step in (1, 2)]).T
    links = coo_array((np.ones(len(start), dtype=np.int32), (start, end)), shape=(count, count)).tocsr()
    links.data[:] = 1
    # Neighbors in common: with more than two, the surface would touch itself.
    shared = (links @ links).multiply(links).tocoo()
    pairs, common = np.stack(shared.coords, -1), shared.data
    corner = np.column_stack((vertices, np.ones(count)))[pairs[:, 1]]
    costs = (np.einsum("mij,mj->mi", quadrics[pairs[:, 0]], corner) * corner).sum(1)
    costs /= np.trace(quadrics[:, :3, :3], axis1=1, axis2=2)[pairs[:, 0]]
    allowed = (common == 2) & (costs <= error**2) & ~fixed[pairs[:, 0]]
    pairs, costs = pairs[allowed], costs[allowed]
    flips = _flips(vertices, faces, pairs)
    pairs, costs = pairs[~flips], costs[~flips]
    order = np.argsort(costs + 0.01 * error**2 * rng.random(len(costs)))
    # The first move of each vertex, if it comes before those of all vertices up to two edges away.
    _, first = np.unique(pairs[order, 0], return_index=True)
    rank = np.full(count, len(order))
    rank[pairs[order[first], 0]] = first
    best = rank
    for _ in range(2):
        near = best.copy()
        np.minimum.at(near, start, best[end])
        best = near
    return pairs[order[first]][best[pairs[order[first], 0]] == first]


def _flips(vertices: np.ndarray, faces: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Returns which moves of a vertex to another one would turn a triangle over, or make it a line: ``[M]``."""
    owner = faces.ravel()
    order = np.argsort(owner, kind="stable")
    starts = np.searchsorted(owner[order], np.arange(len(vertices) + 1))
    counts = (starts[1:] - starts[:-1])[pairs[:, 0]]
    move = np.repeat(np.arange(len(pairs)), counts)
    offset = np.arange(len(move)) - np.repeat(np.cumsum(counts) - counts, counts)
    corners = faces[order[starts[pairs[move, 0]] + offset] // 3]
    moved = np.where(corners == pairs[move, :1], pairs[move, 1:], corners)
    stays = (corners != pairs[move, 1:]).all(1)
    old, new = face_normals(vertices, corners), face_normals(vertices, moved)
    turned = (old * new).sum(1) <= FLIP * np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
    flips = np.zeros(len(pairs), dtype=bool)
    flips[move[stays & turned]] = True
    return flips


def read_mesh(path: Path, up: Up = "auto", scale: float = 1.0) -> list[Piece]:
    """Reads a mesh file: a piece for each node with triangles. See :class:`ImportOptions` for ``up`` and ``scale``."""
    kind, data = path.suffix.lower(), path.read_bytes()
    unit, axis = 1.0, "y" if kind in (".glb", ".gltf") else "z"
    names: set[str] = set()
    if kind == ".dae":
        optional("collada")
        root = read_xml(path)
        unit, axis = _collada_frame(path, root)
        names = _name_by_nodes(root)
        for element in root.iter():
            # Standard XML needs a declaration of prefixes.
            element.tag = element.tag.replace(":", ".")
            element.attrib = {name: value for name, value in element.attrib.items() if ":" not in name}
        data = tostring(root)
    turn = np.eye(4)
    turn[:3, :3] = scale * unit * _TO_Z_UP[axis if up == "auto" else up]
    scene = _load(path, data)
    base = scene.graph.base_frame
    if scene.graph.transforms.parents.get(base, base) != base:
        # trimesh 4 takes the node for its base frame, and loses the transforms above it.
        raise ValueError(f"{path} has a node {base!r} below another one; give it another name")
    pieces = []
    for node in sorted(map(str, scene.graph.nodes_geometry)):
        frame: Any = scene.graph[node]
        transform, name = frame
        mesh = scene.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            # trimesh numbers the parts of a geometry of COLLADA that have materials of their own.
            whole = node.rpartition("_")[0]
            part = whole if whole in names and node not in names else node
            pieces.append(Piece(part, np.asarray(mesh.vertices), np.asarray(mesh.faces), turn @ transform))
    if not pieces:
        raise ValueError(f"{path} holds no triangles")
    if sum(len(mesh.faces) for mesh in scene.geometry.values() if isinstance(mesh, trimesh.Trimesh)) > MAX_FACES:
        raise ValueError(f"{path} has more than {MAX_FACES:,} triangles; simplify it first")
    return pieces


class _GeometryResolver(FilePathResolver):
    """Leaves out materials and textures, which are no geometry, and often missing."""

    def get(self, name: str) -> bytes:
        suffix = Path(name.strip()).suffix.lower()
        if suffix in (".bin", ".glb"):
            return super().get(name.strip())
        return b"" if suffix == ".mtl" else _WHITE_PIXEL


def _load(path: Path, data: bytes) -> trimesh.Scene:
    kind, resolver = path.suffix.lower()[1:], _GeometryResolver(str(path.parent))
    try:
        with logged("trimesh"):
            return trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False)
    # The readers raise errors of all kinds for a damaged file.
    except Exception as error:
        reason = str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"
        raise ValueError(f"{path} cannot be read as a mesh: {reason.splitlines()[0][:200]}") from error


def _collada_frame(path: Path, root: Element) -> tuple[float, str]:
    """Returns the unit (m) and the axis that points up of a COLLADA file."""
    element = root.find("asset/unit")
    text = "1" if element is None else element.get("meter", "1")
    try:
        unit = float(text)
    except ValueError:
        unit = float("nan")
    if not 1e-6 <= unit <= 1e6:
        raise ValueError(f"the unit of {path} must be a positive number of meters, got {text!r}")
    # COLLADA 1.4.1: without up_axis, y points up.
    return unit, {"X_UP": "x", "Y_UP": "y", "Z_UP": "z"}.get(text_of(root.find("asset/up_axis")), "y")


def _name_by_nodes(root: Element) -> set[str]:
    """Gives geometries that one node alone shows its name, which trimesh ignores. Returns the names."""
    shown: dict[str, list[tuple[Element, str]]] = {}
    for node in root.iter("node"):
        for instance in node.findall("instance_geometry"):
            shown.setdefault(instance.get("url", "")[1:], []).append((instance, node.get("name", "")))
    geometries = {geometry.get("id", ""): geometry for geometry in root.iter("geometry")}
    names = {*geometries}
    for key, geometry in geometries.items():
        (instance, name), *others = shown.get(key, [(root, "")])
        if name and not others and name not in names:
            geometry.set("id", name)
            instance.set("url", f"#{name}")
            names.add(name)
    return names
