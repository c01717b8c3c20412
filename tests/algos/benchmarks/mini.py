"""Small data of the benchmarks, in the formats of the public ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

CENTERS = {1: [(-0.075, 0.075), (-1.5, 6.0)], 7: [(-2.25, 6.0), (-2.4, 6.0), (-2.1, 6.0)]}
"""Centers of the cylinders of the worlds, m. World 7 has a wall in front of the start."""
CELLS = {1: [(15, 0), (15, 10), (16, 29)], 7: [(10, 5), (10, 29)]}  # cells of the reference paths

MODEL = """<model name='unit_cylinder_{number}'><static>1</static><pose frame=''>{x:.6f} {y:.6f} 0 0 0 0</pose>
<link name='link'><collision name='collision'><geometry><cylinder><radius>0.075</radius><length>1</length></cylinder>
</geometry></collision></link></model>"""
PLANE = """<model name='ground_plane'><static>1</static><link name='link'><collision name='collision'><geometry><plane>
<normal>0 0 1</normal><size>100 100</size></plane></geometry></collision></link></model>"""


def write_barn_folder(folder: Path) -> Path:
    """Writes the worlds as the public repository has them, and returns its root."""
    worlds = folder / "jackal_helper" / "worlds" / "BARN"
    (worlds / "path_files").mkdir(parents=True)
    for number, centers in CENTERS.items():
        models = "".join(MODEL.format(number=k, x=x, y=y) for k, (x, y) in enumerate(centers))
        state = "<state world_name='default'><model name='unit_cylinder_0'><pose>9 9 0 0 0 0</pose></model></state>"
        text = f"<sdf version='1.6'><world name='default'>{PLANE}{models}{state}</world></sdf>"
        (worlds / f"world_{number}.world").write_text(text)
        np.save(worlds / "path_files" / f"path_{number}.npy", np.array(CELLS[number]))
    return folder


def write_barn_file(path: Path, lengths: Sequence[float]) -> Path:
    """Writes the same worlds as arrays."""
    offsets = np.cumsum([0, *map(len, CENTERS.values())])
    centers = np.concatenate([np.array(part, dtype=np.float32) for part in CENTERS.values()])
    np.savez(path, world=np.array([*CENTERS]), cylinder_xy=centers, offsets=offsets, path_length=np.array(lengths))
    return path


def levels() -> dict[str, np.ndarray]:
    """Three levels of JaxNav, 5 x 5 cells: open ground, a wall in the middle, and one without a way to the goal."""
    maps = np.ones((3, 5, 5), dtype=np.uint8)
    maps[:, 1:4, 1:4] = 0
    maps[1, 1:3, 2] = 1
    maps[2, 1:4, 2] = 1
    return {
        "map_data": maps,
        "start_xy": np.array([[1.5, 1.5]] * 3, dtype=np.float32),
        "start_theta": np.zeros(3, dtype=np.float32),
        "goal_xy": np.array([[3.5, 1.5]] * 3, dtype=np.float32),
        "geodesic8": np.array([2.0, 4.8284273, np.inf], dtype=np.float32),
    }


def write_levels(path: Path, **changes: np.ndarray | None) -> Path:
    """Writes the levels with some arrays changed, or left out if ``None``."""
    arrays = {name: array for name, array in (levels() | changes).items() if array is not None}
    np.savez(path, **arrays)
    return path
