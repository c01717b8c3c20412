"""Smooth random ground: hills of many sizes without steps from cell to cell."""

from __future__ import annotations

import numpy as np


def relief(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell: float,
    wavelengths: tuple[float, float],
    steepness: float = 2.0,
) -> np.ndarray:
    """Random heights ``[rows, columns]`` with mean 0 and standard deviation 1.

    Args:
        rng: where the random numbers come from.
        shape: rows and columns.
        cell: spacing of the grid in meters.
        wavelengths: the shortest and the longest wave in meters. The short end fades out softly.
        steepness: how fast waves lose height as they get shorter: 2 gives rolling hills, 1.5 broken ground.
    """
    shortest, longest = wavelengths
    spectrum = np.fft.rfft2(rng.standard_normal(shape))
    waves = np.hypot(np.fft.fftfreq(shape[0], cell)[:, None], np.fft.rfftfreq(shape[1], cell))
    gain = np.maximum(waves, 1 / longest) ** -steepness * np.exp(-0.5 * (waves * shortest) ** 4)
    gain[waves < 1 / longest] = 0.0
    heights = np.fft.irfft2(spectrum * gain, s=shape)
    return (heights - heights.mean()) / heights.std()
