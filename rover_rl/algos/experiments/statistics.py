"""Statistics of few training runs: interquartile mean and probability of improvement, with bootstrap intervals.

They are those of Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice" (2021,
arXiv:2108.13264). The runs of one experiment in several worlds are strata: runs are resampled within each world. With
few runs, percentile intervals are too narrow: those of three runs reach at most from the worst to the best of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.stats import trim_mean

from rover_rl.algos.evaluation.metrics import RESAMPLES, Estimate

_ENDS = (0.025, 0.975)  # quantiles of the ends of an interval
_CUT = 0.25  # share of the values that is left out at each end


def interquartile_mean(strata: Sequence[np.ndarray]) -> Estimate:
    """Mean of the middle half of all values, with its 95 % interval.

    Of fewer than four values it is the mean. With one value in each stratum there is no interval. ``strata`` are the
    values of the runs in each world, ``[runs]`` each.

    Example:
        >>> round(interquartile_mean([np.array([0.1, 0.8, 0.9, 0.9])]).value, 3)
        0.85
    """
    low, high = interval(strata)
    return Estimate(float(trim_mean(np.concatenate(strata), _CUT)), float(low), float(high))


def interval(strata: Sequence[np.ndarray]) -> np.ndarray:
    """Ends of the 95 % interval of the interquartile mean, ``[2, ...]``; nan if each stratum has one run."""
    if all(len(values) == 1 for values in strata):
        return np.full((2, *strata[0].shape[1:]), math.nan)
    generator = np.random.default_rng(0)
    drawn = np.concatenate([_resampled(values, generator) for values in strata], 1)
    return np.quantile(trim_mean(drawn, _CUT, axis=1), _ENDS, axis=0)


def probability_of_improvement(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray]) -> Estimate:
    """Probability that a run of one experiment is better than one of another, with its 95 % interval.

    Equal values count one half. Over several worlds, it is the mean of the probabilities in each. The values are those
    of the runs in each world, ``[runs]`` each.

    Example:
        >>> probability_of_improvement([np.array([0.9, 0.8])], [np.array([0.8, 0.7])]).value
        0.875
    """
    value = float(np.mean([_better(a, b) for a, b in zip(ours, theirs, strict=True)]))
    if all(len(values) == 1 for values in (*ours, *theirs)):
        return Estimate(value, math.nan, math.nan)
    generator = np.random.default_rng(0)
    pairs = [(_resampled(a, generator), _resampled(b, generator)) for a, b in zip(ours, theirs, strict=True)]
    low, high = np.quantile(np.mean([_better(a, b) for a, b in pairs], 0), _ENDS)
    return Estimate(value, float(low), float(high))


def _resampled(values: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    return values[generator.integers(len(values), size=(RESAMPLES, len(values)))]


def _better(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    difference = np.sign(a[..., :, None] - b[..., None, :])
    return (0.5 + difference / 2).mean((-2, -1))
