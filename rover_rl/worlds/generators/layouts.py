"""Parts of layouts: difficulties, areas, smooth height fields, open ground, and enclosing walls."""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import label

from rover_rl.worlds.region import Area
from rover_rl.worlds.solids import Solids, boxes
from rover_rl.worlds.terrain import MAX_SLOPE

DEFAULT = 0.5
WALL_THICKNESS, WALL_HEIGHT = 0.2, 2.0
"""Of the walls around a floor, m."""


def scaled(difficulty: float, easy: float, default: float, hard: float) -> float:
    """Returns a parameter at a difficulty, piecewise linear between its values at 0, 0.5 (exact) and 1."""
    if not 0 <= difficulty <= 1:
        raise ValueError(f"difficulty must be a number from 0 to 1, got {difficulty}")
    if difficulty == DEFAULT:
        return default
    share = abs(difficulty - DEFAULT) / DEFAULT
    return default + share * ((hard if difficulty > DEFAULT else easy) - default)


def square(half: float) -> Area:
    """Returns the area up to ``half`` (m) from the origin along both axes."""
    return ((-half, half), (-half, half))


def raised(xy: np.ndarray, height: float) -> np.ndarray:
    """Adds a height (m) to points ``[N, 2]``."""
    return np.column_stack((xy, np.full(len(xy), height)))


def relief(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell: float,
    wavelengths: tuple[float, float],
    steepness: float = 2,
) -> np.ndarray:
    """Samples random heights with mean 0 and standard deviation 1 from a power-law spectrum: ``[rows, columns]``.

    The spectrum is cut off smoothly at the shortest of two ``wavelengths``, m. Amplitudes are proportional to
    ``wavelength ** steepness``: 2 gives rolling hills, 1.5 rough ground.
    """
    shortest, longest = wavelengths
    spectrum = np.fft.rfft2(rng.standard_normal(shape))
    waves = np.hypot(np.fft.fftfreq(shape[0], cell)[:, None], np.fft.rfftfreq(shape[1], cell))
    gain = np.maximum(waves, 1 / longest) ** -steepness * np.exp(-0.5 * (waves * shortest) ** 4)
    gain[waves < 1 / longest] = 0.0
    heights = np.fft.irfft2(spectrum * gain, s=shape)
    return (heights - heights.mean()) / heights.std()


def smoothstep(t: np.ndarray) -> np.ndarray:
    """Returns a smooth transition from 0 at ``t <= 0`` to 1 at ``t >= 1``."""
    t = np.clip(t, 0, 1)
    return t * t * (3 - 2 * t)


def in_square(half: float, cell: float, count: int) -> np.ndarray:
    """Returns which of ``count`` x ``count`` cells around the origin have their centers in ``square(half)``."""
    inside = np.abs(cell_centers(cell, count)) < half
    return np.logical_and.outer(inside, inside)


def cell_centers(cell: float, count: int) -> np.ndarray:
    """Returns the coordinates of the centers of cells along an axis, m."""
    return cell * (np.arange(count) - (count - 1) / 2)


def is_connected(open_cells: np.ndarray, inside: np.ndarray, of_open: float, of_all: float) -> bool:
    """Returns whether the largest part of the open cells has these shares of the open, and of all cells ``inside``."""
    counts = np.bincount(label(open_cells)[0][inside])
    largest = counts[1:].max(initial=0)
    return bool(largest / max(counts[1:].sum(), 1) >= of_open and largest / counts.sum() >= of_all)


def gentle_cells(heights: np.ndarray, cell: float) -> np.ndarray:
    """Returns which cells have no triangle steeper than :data:`MAX_SLOPE`: bool ``[rows - 1, columns - 1]``."""
    along_x, along_y = np.diff(heights, axis=1), np.diff(heights, axis=0)
    lower, upper = np.hypot(along_x[:-1], along_y[:, :-1]), np.hypot(along_x[1:], along_y[:, 1:])
    return np.maximum(lower, upper) <= math.tan(MAX_SLOPE) * cell


def enclosing_walls(side: float) -> Solids:
    """Creates four walls just outside a square floor around the origin, so that all of the floor is free."""
    middle, length = (side + WALL_THICKNESS) / 2, side + 2 * WALL_THICKNESS
    centers = raised(np.array([(0, -middle), (0, middle), (-middle, 0), (middle, 0)]), WALL_HEIGHT / 2)
    along_x, along_y = (length, WALL_THICKNESS, WALL_HEIGHT), (WALL_THICKNESS, length, WALL_HEIGHT)
    return boxes(centers, [along_x, along_x, along_y, along_y])
