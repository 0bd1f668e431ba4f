import numpy as np
import pytest

from avp_habitat.navigation.build import area_in_outline
from avp_habitat.navigation.settings import NavigationSettings

FLOOR_M = 0.07


def strip(x0, x1, z0, z1, y):
    """Two triangles that fill a rectangle at height y."""
    a, b, c, d = (x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)
    return [[a, b, c], [a, c, d]]


def bounds_of(triangles):
    return np.stack([triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))])


def flat_floor(points):
    return np.where(points[:, 1] >= FLOOR_M, FLOOR_M, np.nan)


def test_a_foreign_navigation_mesh_becomes_the_area_on_the_true_floor():
    # An L of two rectangles whose common edge agrees up to a hundredth of a millimetre, 0.2 m above the floor.
    triangles = np.array(strip(0, 3, 0, 1, 0.27) + strip(0, 1, 1.00001, 4, 0.27))
    area = area_in_outline(triangles, flat_floor, NavigationSettings(), bounds_of(triangles))
    assert area.area_m2 == pytest.approx(6.0, abs=0.01)
    assert len(area.centres) * 0.01 == pytest.approx(6.0, abs=0.1)
    np.testing.assert_allclose(area.centres[:, 1], FLOOR_M)
    assert area.contains(np.array([[2.9, 0, 0.5], [0.5, 0, 3.9], [2.0, 0, 2.0]])).tolist() == [True, True, False]
    walked = area.slide(np.array([[0.5, 0, 0.5]]), np.array([[0.0, 0, 3.0]]))
    np.testing.assert_allclose(walked[0], [0.5, FLOOR_M, 3.5], atol=1e-6)


def test_of_separate_pieces_the_largest_is_taken():
    triangles = np.array(strip(0, 1, 0, 1, 0.2) + strip(5, 8, 0, 1, 0.2))
    assert area_in_outline(triangles, flat_floor, NavigationSettings(), bounds_of(triangles)).area_m2 == pytest.approx(
        3.0, abs=0.01
    )
