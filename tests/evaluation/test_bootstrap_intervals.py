"""Metrics over several seeds, against values computed by hand, and the coverage of intervals."""

import numpy as np
import pytest
import scipy.stats

from jetbot_mjx.evaluation.bootstrap_intervals import (
    Estimate,
    bootstrap,
    bootstrap_interval,
    interquartile_mean,
    mean_difference,
    median_estimate,
    probability_of_improvement,
)


def test_the_interquartile_mean_leaves_out_a_quarter_at_each_end():
    values = [-90.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 90.0]
    assert interquartile_mean(np.array(values)) == 3.5
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0
    np.testing.assert_array_equal(interquartile_mean(np.array([values, values])), [3.5, 3.5])


def test_the_probability_of_improvement_by_hand():
    # Of nine pairs four are won and two even.
    assert probability_of_improvement([1.0, 2.0, 3.0], [1.0, 2.0, 2.5]) == pytest.approx(5 / 9)
    assert probability_of_improvement([1.0], [1.0, 1.0]) == 0.5


def test_the_probability_of_improvement_is_mann_whitneys_u():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 5, 7).astype(float), rng.integers(0, 5, 4).astype(float)
    u = scipy.stats.mannwhitneyu(a, b).statistic
    assert probability_of_improvement(a, b) == pytest.approx(u / 28)


def test_an_interval_is_that_of_the_means_over_drawn_seeds():
    rng = np.random.default_rng(0)
    values = rng.normal(size=30)
    value, low, high = bootstrap(np.mean, values.tolist())
    drawn = rng.choice(values, (20_000, 30)).mean(axis=-1)
    assert value == pytest.approx(values.mean())
    np.testing.assert_allclose([low, high], np.percentile(drawn, [2.5, 97.5]), atol=0.01)
    assert bootstrap(np.mean, values.tolist()) == (value, low, high)


def test_every_sample_is_drawn_from_by_itself():
    # Drawn from both together, the difference would vary.
    found = bootstrap(mean_difference, [1.0, 1.0, 1.0], [0.25, 0.25])
    assert found == Estimate(0.75, 0.75, 0.75)


def test_one_seed_has_no_interval_and_none_no_figure():
    assert bootstrap(np.mean, [0.5]) == Estimate(0.5)
    assert bootstrap(mean_difference, [0.5], [0.25, 0.5]) == Estimate(0.125)
    assert bootstrap(np.mean, []) == Estimate(None)


def test_a_band_is_the_interval_of_every_column():
    values = np.random.default_rng(0).random((5, 3))
    low, high = bootstrap_interval(np.mean, [values], axis=0)
    for column in range(3):
        _, *ends = bootstrap(np.mean, values[:, column].tolist())
        np.testing.assert_allclose([low[column], high[column]], ends, atol=0.02)


def test_the_interval_of_a_median_covers_the_truth():
    rng = np.random.default_rng(0)
    found = [median_estimate(rng.exponential(size=100)) for _ in range(1000)]
    covered = np.mean([one.low <= np.log(2) <= one.high for one in found])
    assert covered >= 0.93


def test_a_median_of_few_values_has_no_interval():
    assert median_estimate(np.arange(5.0)) == Estimate(2.0)
    assert median_estimate(np.arange(7.0)) == Estimate(3.0, 0.0, 6.0)
    assert median_estimate(np.zeros(0)) == Estimate(None)
