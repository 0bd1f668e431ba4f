import numpy as np
import pytest
from scipy import stats

from avp_experiment.statistics import at_views, spearman, views_to_reach


def test_correlation_with_equal_values_is_that_of_scipy():
    rng = np.random.default_rng(3)
    x, y = rng.integers(0, 6, (2, 60))
    assert spearman(x, y, list(range(60))).rho == pytest.approx(stats.spearmanr(x, y)[0])
    assert spearman(x, np.ones(60), list(range(60))) is None


def test_reconstructions_of_one_rollout_are_drawn_together():
    rng = np.random.default_rng(0)
    x = np.repeat(rng.normal(size=12), 10)
    y = np.repeat(rng.normal(size=12), 10)
    together = spearman(x, y, np.repeat(np.arange(12), 10).tolist())
    apart = spearman(x, y, list(range(120)))
    assert together.rho == apart.rho
    assert together.high - together.low > 2 * (apart.high - apart.low)


def test_between_measured_views_a_curve_is_linear_and_outside_it_is_unknown():
    curve = {20: 10.0, 40: 14.0, 60: 13.0, 80: 20.0}
    assert at_views(curve, 30) == 12
    assert at_views(curve, 80) == 20
    assert at_views(curve, 19) is None
    assert at_views(curve, 81) is None
    assert views_to_reach(curve, 12) == 30
    assert views_to_reach(curve, 16.5) == 70
    assert views_to_reach(curve, 9) == 20
    assert views_to_reach(curve, 21) is None
