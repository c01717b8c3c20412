"""Smooth random height fields and transitions."""

from __future__ import annotations

import numpy as np


def relief(
    rng: np.random.Generator,
    shape: tuple[int, int],
    cell: float,
    wavelengths: tuple[float, float],
    steepness: float = 2.0,
) -> np.ndarray:
    """Samples random heights with mean 0 and standard deviation 1 from a power-law spectrum.

    Args:
        rng: random number generator.
        shape: number of rows and columns.
        cell: spacing of the grid, m.
        wavelengths: shortest and longest wavelength, m. The spectrum is cut off smoothly at the shortest.
        steepness: exponent of the spectrum: amplitudes are proportional to ``wavelength ** steepness``. 2 gives
            rolling hills, 1.5 rough ground.

    Returns:
        Heights ``[rows, columns]``.
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
