import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from avp_habitat import metrics


@given(st.integers(0, 100_000), st.integers(1, 9), st.integers(1, 7))
def test_coverage_is_the_observed_share_of_navigable_cells(seed, rows, columns):
    rng = np.random.default_rng(seed)
    observed, navigable = rng.random((2, rows, columns)) < 0.5
    navigable[0, 0] = True
    seen = total = 0
    for row in range(rows):
        for column in range(columns):
            total += int(navigable[row, column])
            seen += int(observed[row, column] and navigable[row, column])
    assert metrics.coverage(observed, navigable) == pytest.approx(seen / total)


@given(st.integers(0, 100_000), st.integers(2, 12))
def test_annd_is_the_mean_distance_to_the_nearest_other_camera(seed, count):
    points = np.random.default_rng(seed).normal(size=(count, 3))
    nearest = []
    for i in range(count):
        nearest.append(min(np.sqrt(((points[i] - points[j]) ** 2).sum()) for j in range(count) if j != i))
    assert metrics.nearest_neighbour_distance(points) == pytest.approx(sum(nearest) / count)


def test_annd_of_one_camera_or_none_is_zero():
    assert metrics.nearest_neighbour_distance(np.zeros((1, 3))) == 0.0
    assert metrics.nearest_neighbour_distance(np.zeros((0, 3))) == 0.0


def test_ei_is_coverage_per_image():
    assert metrics.efficiency_index(0.88, 44) == pytest.approx(0.02)
    assert metrics.efficiency_index(0.0, 0) == 0.0


def test_cpv_divides_mean_coverage_by_mean_length_not_the_mean_of_quotients():
    assert metrics.coverage_per_view(np.array([0.9, 0.3]), np.array([80, 20])) == pytest.approx(100 * 0.6 / 50)
    assert metrics.coverage_per_view(np.array([]), np.array([])) == 0.0


def test_path_length_starts_at_the_start():
    assert metrics.path_length(np.array([0.0, 0, 3]), np.array([[4.0, 0, 0], [4, 0, 1]])) == pytest.approx(6.0)
