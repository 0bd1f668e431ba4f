import numpy as np
import pytest
from corridor import Corridor, hit_distance
from hypothesis import given, settings
from hypothesis import strategies as st

from avp_habitat import poses
from avp_habitat.poses import Intrinsics
from avp_habitat.sight.rules import candidates, visible_in_depth
from avp_habitat.task.cast import cells_passed_over

SIMULATOR = Corridor()
CELLS = SIMULATOR.area.centres
TOLERANCE = 0.1


def random_poses(seed, count):
    rng = np.random.default_rng(seed)
    position = SIMULATOR.area.random_points(rng, count) + [0, 1.5, 0]
    return poses.camera_to_world(position, yaw=rng.uniform(-3, 3, count), pitch=rng.uniform(-0.9, 0.7, count))


def seen_by_brute_force(pose, camera, point, max_range_m):
    """Inside the image, in range, and nothing nearer on the ray: one cell at a time, from first principles."""
    local = np.linalg.inv(poses.habitat_to_opencv(pose)) @ np.append(point, 1.0)
    if local[2] <= 0:
        return False
    u, v, w = camera.matrix @ local[:3]
    if not (0 <= u / w < camera.width and 0 <= v / w < camera.height):
        return False
    ray = point - pose[:3, 3]
    length = np.sqrt(ray @ ray)
    return length <= max_range_m and hit_distance(pose[None, :3, 3], ray[None] / length)[0] >= length - TOLERANCE


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 10_000), max_range_m=st.sampled_from([1.9, 3.1, 10.0]))
def test_candidates_and_occlusion_rays_equal_the_definition(seed, max_range_m):
    camera = Intrinsics.from_hfov(16, 9, hfov_deg=80)
    pose = random_poses(seed, 2)
    unseen = np.random.default_rng(seed).random((2, len(CELLS))) < 0.8
    pairs = candidates(pose, camera, CELLS, unseen, max_range_m=max_range_m)
    reached = SIMULATOR.visible(pose, camera, CELLS, pairs, tolerance_m=TOLERANCE)
    found = np.zeros_like(unseen)
    found[pairs[reached, 0], pairs[reached, 1]] = True
    for agent in range(2):
        for cell, point in enumerate(CELLS):
            expected = unseen[agent, cell] and seen_by_brute_force(pose[agent], camera, point, max_range_m)
            assert found[agent, cell] == expected


@pytest.mark.parametrize(("width", "height"), [(160, 120), (640, 480)])
def test_depth_images_agree_with_occlusion_rays_at_any_resolution(width, height):
    camera = Intrinsics.from_hfov(width, height, hfov_deg=90)
    pose = random_poses(7, 12)
    pairs = candidates(pose, camera, CELLS, np.ones((12, len(CELLS)), dtype=bool), max_range_m=10.0)
    depth = SIMULATOR.render(pose, camera, rgb=False).depth
    by_depth = visible_in_depth(pose, camera, depth, CELLS, pairs, tolerance_m=TOLERANCE)
    by_rays = SIMULATOR.visible(pose, camera, CELLS, pairs, tolerance_m=TOLERANCE)
    assert 0.2 < by_rays.mean() < 0.98, "the wall must hide some cells for this test to mean anything"
    assert (by_depth == by_rays).mean() > 0.99
    assert by_depth.mean() == pytest.approx(by_rays.mean(), abs=0.005)


def test_far_floor_is_seen_in_a_coarse_depth_image():
    # Rows of a 12 pixel high image lie up to 1.4 m apart on this floor: a nearest-pixel comparison would lose half.
    camera = Intrinsics.from_hfov(16, 12, hfov_deg=90)
    pose = poses.camera_to_world(np.array([[0.3, 1.5, 2.5]]), yaw=np.array([-np.pi / 2]), pitch=np.array([0.0]))
    points = np.stack([np.linspace(2.5, 5.0, 40), np.zeros(40), np.full(40, 2.4)], axis=1)
    pairs = candidates(pose, camera, points, np.ones((1, 40), dtype=bool), max_range_m=10.0)
    depth = SIMULATOR.render(pose, camera, rgb=False).depth
    assert len(pairs) == 40
    assert visible_in_depth(pose, camera, depth, points, pairs, tolerance_m=TOLERANCE).all()


def test_cells_passed_over_equal_dense_sampling_along_every_ray():
    camera = Intrinsics.from_hfov(9, 6, hfov_deg=90)
    pose = random_poses(3, 3)
    area = SIMULATOR.area
    index = np.full(area.mask.shape, -1)
    index[area.mask] = np.arange(len(CELLS))
    depth = SIMULATOR.render(pose, camera, rgb=False).depth
    depth[0, 0, 0] = 0.0
    over = cells_passed_over(pose, camera, depth, area, max_range_m=4.0)
    for agent in range(3):
        sampled = np.zeros(len(CELLS), dtype=bool)
        local = poses.pixel_directions(camera)
        for v in range(6):
            for u in range(9):
                reach = 4.0 / np.linalg.norm(local[v, u])
                end = min(depth[agent, v, u], reach) if depth[agent, v, u] > 0 else reach
                steps = np.linspace(0, end, 20_000)[:, None]
                points = pose[agent, :3, 3] + steps * (pose[agent, :3, :3] @ local[v, u])
                cells = index[tuple(np.clip(area.cell_of(points), 0, np.array(area.mask.shape) - 1).T)]
                sampled[cells[cells >= 0]] = True
        # Dense sampling can miss a cell whose corner a ray cuts by less than its spacing, never the other way round.
        assert not (sampled & ~over[agent]).any()
        assert (over[agent] & ~sampled).sum() <= 3
