"""Triangle meshes as arrays: ``vertices [V, 3]`` in meters, and ``faces [F, 3]``, counter-clockwise from outside."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.spatial import ConvexHull, QhullError, cKDTree
from trimesh.graph import connected_components, face_adjacency, is_watertight
from trimesh.triangles import closest_point

from rover_rl.worlds.files.contents import Piece

MERGE = 1e-5
"""Vertices of a mesh that are closer than this are one, m."""
COVERED = 1e-3
"""Distance from other triangles up to which a triangle is a double of them, m."""
SAMPLES = 20_000
"""Number of random points of a surface that stand for it."""
MAX_PAIRS = 1_000_000
"""Number of pairs of a point and a triangle whose distances are computed at once."""
NEAR = 8
"""Number of random points of a surface near a point whose triangles may be the nearest one."""
CHUNK = 4_000_000
"""Number of pairs of a triangle and a grid point that are tested at once."""
MAX_ROUNDS = 200
LEAST_SHARE = 0.002
"""Share of the vertices that a round of the simplification must remove, or else it is the last one."""
FLIP = 0.3
"""Least cosine of the angle by which a merge of vertices may turn a triangle."""


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
        double = 0 < len(same) * len(samples) < MAX_PAIRS and len(groups) <= 2 * most
        if not double or _exact_distances(samples, vertices[faces[same]]).max() > COVERED:
            kept = np.append(kept, group)
            yield group


def surface_samples(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Returns seven points of each triangle, beside its corners: ``[7 F, 3]``."""
    shares = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4], [1, 1, 0], [1, 0, 1], [0, 1, 1]], dtype=float)
    return np.einsum("sk,fkd->fsd", shares / shares.sum(1, keepdims=True), vertices[faces]).reshape(-1, 3)


def random_points(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Samples points on triangles, in proportion to their areas: ``[count, 3]``, and their triangles ``[count]``."""
    rng = np.random.default_rng(0)
    area = np.linalg.norm(face_normals(vertices, faces), axis=1)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.random((2, count, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = (vertices[faces[chosen, k]] for k in range(3))
    return a + u * (b - a) + v * (c - a), chosen


def distances(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, limit: float) -> np.ndarray:
    """Returns the distances of points from the nearest triangle: ``[P]``, m. Up to ``limit``, they may be too large."""
    samples, owners = random_points(vertices, faces, SAMPLES)
    samples, owners = np.concatenate((samples, vertices[faces].mean(1))), np.append(owners, np.arange(len(faces)))
    # Of large triangles, the nearest sample is far, but the triangle is the right one.
    near = owners[cKDTree(samples).query(points, k=NEAR)[1]]
    nearest = closest_point(vertices[faces[near.ravel()]], np.repeat(points, NEAR, axis=0))
    found = np.linalg.norm(nearest.reshape(-1, NEAR, 3) - points[:, None], axis=2).min(1)
    far = np.flatnonzero(found > limit)[: MAX_PAIRS // len(faces)]
    found[far] = _exact_distances(points[far], vertices[faces])
    return found


def _exact_distances(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    count = len(triangles)
    nearest = closest_point(np.tile(triangles, (len(points), 1, 1)), np.repeat(points, count, axis=0))
    return np.linalg.norm(nearest.reshape(-1, count, 3) - points[:, None], axis=2).min(1)


def surface_heights(
    vertices: np.ndarray, faces: np.ndarray, origin: tuple[float, float], cell: float, shape: tuple[int, int]
) -> np.ndarray:
    """Returns the lowest height of a surface without vertical faces at each point of a grid, by vertical rays.

    The grid begins at ``origin``, ``(x, y)``, m, with points ``cell`` m apart; ``shape`` is their number along y and x.
    Heights are ``[rows, columns]``, m, NaN where there is no triangle.
    """
    heights = np.full(shape[0] * shape[1], np.inf)
    # Grid coordinates: column, row, and height in meters.
    corners = (vertices[faces] - (*origin, 0.0)) / (cell, cell, 1.0)
    low = np.clip(np.ceil(corners[..., :2].min(1) - 1e-6).astype(int), 0, None)
    high = np.minimum(np.floor(corners[..., :2].max(1) + 1e-6).astype(int), (shape[1] - 1, shape[0] - 1))
    span = np.clip(high - low + 1, 0, None)
    count = span[:, 0] * span[:, 1]
    order, start = np.flatnonzero(count), 0
    while start < len(order):
        stop = start + max(1, int(np.searchsorted(np.cumsum(count[order[start:]]), CHUNK)))
        chosen = order[start:stop]
        # Every grid point of the bounding rectangle of every triangle.
        triangle = np.repeat(chosen, count[chosen])
        place = np.arange(len(triangle)) - np.repeat(np.cumsum(count[chosen]) - count[chosen], count[chosen])
        column, row = low[triangle, 0] + place % span[triangle, 0], low[triangle, 1] + place // span[triangle, 0]
        a, b, c = corners[triangle].swapaxes(0, 1)
        # Barycentric coordinates of the point in the triangle's projection.
        area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
        x, y = column - a[:, 0], row - a[:, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            v = (x * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * y) / area
            w = ((b[:, 0] - a[:, 0]) * y - x * (b[:, 1] - a[:, 1])) / area
            inside = (v >= -1e-6) & (w >= -1e-6) & (v + w <= 1 + 1e-6)
            z = a[:, 2] + v * (b[:, 2] - a[:, 2]) + w * (c[:, 2] - a[:, 2])
        np.minimum.at(heights, (row * shape[1] + column)[inside], z[inside])
        start = stop
    heights[np.isinf(heights)] = np.nan
    return heights.reshape(shape)


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
