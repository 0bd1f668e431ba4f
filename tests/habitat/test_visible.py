"""What `Simulator.visible` answers, against a box room's own geometry: the same in every simulator.

The room is `shapes.furnished`: 6 x 2.8 x 4 m around (0, 1.4, 0), with a cupboard on the floor beside its -z wall.
"""

import weakref

import numpy as np
import pytest
from shapes import furnished, mesh_of, write_room

from avp_habitat.policies.oracle.places import scene_places
from avp_habitat.policies.oracle.policy import OraclePolicy, SurveyPolicy
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.scenes.loader import Scene
from avp_habitat.sight.bits import unpack
from avp_habitat.sight.tables import reached_around
from avp_habitat.simulators.base import SingleRays
from avp_habitat.simulators.habitat import HabitatSimulator
from avp_habitat.simulators.raycast import RaycastSimulator
from avp_habitat.task.agent_view import agent_views
from avp_habitat.task.env import AVPEnv

ROOM = np.array([[-3, 0, -2], [3, 2.8, 2]], float)
CUPBOARD = np.array([[0.5, 0, -2], [2, 1.9, -0.8]])
EYE = np.array([-1.0, 1.5, 1.0])
NARROW, WIDE, PORTRAIT = (
    Intrinsics.from_hfov(*size, hfov_deg=angle)
    for size, angle in (((160, 120), 90), ((160, 120), 120), ((60, 160), 90))
)
CAMERAS = {
    "narrow": NARROW,
    "wide": WIDE,
    "widest": Intrinsics.from_hfov(160, 120, hfov_deg=150),
    "portrait": PORTRAIT,
    "few pixels": Intrinsics.from_hfov(37, 20, hfov_deg=70),
    "many pixels": Intrinsics.from_hfov(500, 700, hfov_deg=60),
    "off centre": Intrinsics(160, 120, 90.0, 90.0, 40.0, 95.0),
}


class AdapterOverRays(HabitatSimulator):
    """What the suite adds to Habitat-Sim's depth images, over those of the ray caster: it runs anywhere."""

    def __init__(self, engine):
        self._engine, self._area = engine, engine.area
        self.scene, self.scene_digest, self.version = "room", "", ""
        self._closing = weakref.finalize(self, int)


@pytest.fixture(scope="module", params=["raycast", "adapter", pytest.param("habitat", marks=pytest.mark.habitat)])
def simulator(request, tmp_path_factory):
    rays = RaycastSimulator(Scene("room", "0" * 64, mesh_of(furnished())))
    if request.param == "raycast":
        yield rays
        return
    if request.param == "adapter":
        yield AdapterOverRays(rays)
        return
    opened = HabitatSimulator(str(write_room(tmp_path_factory.mktemp("room") / "room.glb", furnished())))
    yield opened
    opened.close()


def clear(eye, points, tolerance_m=0.1):
    """`(k,)` whether nothing but what is nearer to `(k, 3)` points than the tolerance blocks lines from an eye."""
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = points - eye
        low, high = (ROOM - eye)[:, None] / offset
        leave = np.maximum(low, high).min(axis=1)
        low, high = (CUPBOARD - eye)[:, None] / offset
        enter, end = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
    hit = np.minimum(leave, np.where((enter <= end) & (enter > 0), enter, np.inf))
    return hit * np.linalg.norm(offset, axis=1) >= np.linalg.norm(offset, axis=1) - tolerance_m


def inside(camera, yaw, pitch, offset):
    """`(k,)` whether directions lie in the image of a camera turned so, by its angles."""
    forward = np.array([-np.sin(yaw) * np.cos(pitch), np.sin(pitch), -np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0, -np.sin(yaw)])
    ahead, aside, above = (offset @ axis for axis in (forward, right, np.cross(right, forward)))
    with np.errstate(divide="ignore"):
        x, y = aside / ahead * camera.fx + camera.cx, camera.cy - above / ahead * camera.fy
    return (ahead > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)


@pytest.mark.parametrize(
    ("camera", "offset", "expected"),
    [
        ("narrow", (0, 0, -2.9), True),
        ("narrow", (0, 0, 0.9), False),  # Behind the camera,
        ("wide", (0.2, -0.1, 0.5), False),
        ("narrow", (0, 0, -4), False),  # behind the wall,
        ("wide", (3.4, -0.5, -2.5), False),  # behind the cupboard,
        ("wide", (3.4, 0.9, -2.6), True),  # above it,
        ("narrow", (-1.2, 0, -1), False),  # beside the image, within it at 120 degrees,
        ("wide", (-1.2, 0, -1), True),
        ("wide", (-1.8, 0, -1), False),
        ("narrow", (0, 0.9, -1), False),  # above the image, within it in portrait,
        ("portrait", (0, 0.9, -1), True),
        ("portrait", (0, -1.5, -0.9), True),
        ("portrait", (0, -1.5, -0.5), False),  # below it,
        ("off centre", (1.2, 0, -1), True),
        ("off centre", (-0.5, 0, -1), False),  # and where only a centred image would show it.
    ],
)
def test_a_point_is_seen_within_the_image_asked_for_and_nowhere_else(simulator, camera, offset, expected):
    point, pose = EYE + [offset], camera_to_world(EYE[None], yaw=np.zeros(1), pitch=np.zeros(1))
    pair = np.array([[0, 0]])
    assert simulator.visible(pose, CAMERAS[camera], point, pair, tolerance_m=0.1).tolist() == [expected]


@pytest.mark.parametrize("camera", CAMERAS)
def test_cameras_turned_anyhow_see_what_the_geometry_says(simulator, camera):
    rng = np.random.default_rng(3)
    eyes = rng.uniform([-2.8, 0.3, -0.5], [2.8, 2.5, 1.8], (10, 3))
    yaw, pitch = rng.uniform(-np.pi, np.pi, 10), rng.uniform(-1.2, 1.2, 10)
    # Over the walls into the next rooms; not in the cupboard's own sides, where a millimetre decides.
    points = rng.uniform([-4, 0, -3], [4, 2.8, 3], (1000, 3))
    truth = np.array([clear(eye, points) for eye in eyes])
    turned = zip(yaw, pitch, eyes, strict=True)
    in_image = np.array([inside(CAMERAS[camera], *turn, points - eye) for *turn, eye in turned])
    pairs = rng.permutation(np.argwhere(np.ones_like(truth)))
    seen = np.zeros_like(truth)
    poses = camera_to_world(eyes, yaw=yaw, pitch=pitch)
    seen[tuple(pairs.T)] = simulator.visible(poses, CAMERAS[camera], points, pairs, tolerance_m=0.1)
    assert not seen[~in_image].any()
    assert 0.2 < truth[in_image].mean() < 0.8
    assert (seen == truth)[in_image].mean() >= (1 if isinstance(simulator, SingleRays) else 0.99)


def test_places_reach_points_in_every_direction(simulator):
    rng = np.random.default_rng(4)
    eyes = rng.uniform([-2.8, 0.3, -0.5], [2.8, 2.5, 1.8], (6, 3))
    points = np.concatenate(
        [rng.uniform([-4, 0, -3], [4, 2.8, 3], (1000, 3)), eyes[:1] + np.array([[1, 1, 1], [0, 1, 0]])]
    )
    pairs = np.argwhere(np.ones((len(eyes), len(points)), bool))
    truth = np.array([clear(eye, points) for eye in eyes]).ravel()
    seen = reached_around(simulator, eyes, points, pairs, tolerance_m=0.1)
    assert 0.2 < truth.mean() < 0.8
    assert (seen == truth).mean() >= (1 if isinstance(simulator, SingleRays) else 0.99)


def test_planners_that_know_the_scene_plan_in_either(simulator, monkeypatch):
    """What the places see is what the geometry says; what is planned is what the episode then counts."""
    if not isinstance(simulator, SingleRays):  # It looks around with pictures, each of whose pixels costs a ray here.
        monkeypatch.setattr("avp_habitat.policies.oracle.places._PANORAMAS", 12)
    env = AVPEnv(simulator=simulator, budget=12, reward="coverage", width=32, height=24)
    places = scene_places(simulator, env.settings)
    sees = unpack(places.sees, len(places.points))
    truth = np.array([clear(place + [0, 1.5, 0], places.points) for place in places.position])
    assert (sees == truth).mean() >= 0.99
    for kind in (OraclePolicy, SurveyPolicy):
        policy = kind(lambda: agent_views(env), width=30)
        (observation, _), info = env.reset(seed=1), {}
        for _ in range(12):
            observation, *_, info = env.step(int(policy.predict(observation)[0]))
        assert info["coverage"] == pytest.approx(policy.planner(0).plan.coverage[-1], abs=1e-9)
        assert info["coverage"] > 0.6
