from __future__ import annotations

import math

import numpy as np
import pytest

from rover_rl.algos.experiments.statistics import interquartile_mean, probability_of_improvement


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end() -> None:
    values = np.array([0.0, 0.5, 0.7, 1.0])
    assert interquartile_mean([values]).value == pytest.approx(0.6)
    assert interquartile_mean([values[1:]]).value == pytest.approx(values[1:].mean())
    # Over worlds, it is that of all values.
    assert interquartile_mean([values[:2], values[2:]]).value == pytest.approx(0.6)


def test_intervals_resample_runs_within_each_world() -> None:
    apart = interquartile_mean([np.full(3, 0.2), np.full(3, 0.8)])
    assert (apart.low, apart.value, apart.high) == pytest.approx((0.5, 0.5, 0.5))
    together = interquartile_mean([np.array([0.2, 0.8] * 3)])
    assert together.low < 0.35
    assert together.high > 0.65


def test_one_run_has_no_interval() -> None:
    assert math.isnan(interquartile_mean([np.array([0.4])]).low)
    assert math.isnan(probability_of_improvement([np.array([0.4])], [np.array([0.3])]).low)


def test_the_probability_of_improvement_counts_pairs() -> None:
    ours, theirs = np.array([0.9, 0.5, 0.5]), np.array([0.5, 0.4])
    estimate = probability_of_improvement([ours], [theirs])
    # 0.9 wins twice; each 0.5 wins once and is equal once.
    assert estimate.value == pytest.approx((2 + 2 * (0.5 + 1)) / 6)
    assert estimate.low <= estimate.value <= estimate.high
    assert probability_of_improvement([theirs], [ours]).value == pytest.approx(1 - estimate.value)
