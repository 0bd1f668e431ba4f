"""How much has to speak against a pose before the pictures name it."""

from dataclasses import replace

import numpy as np
import pytest
from picture_walk import CAMERA, walk_poses, write_walk
from wall_walk import TURNING, WALKING, write_wall

from avp_habitat.poses import camera_to_world
from avp_habitat.rollout.format import read_rollout
from avp_nerfstudio.check.__main__ import Check, check
from avp_nerfstudio.check.pictures.causes import best_focal_factor, gain_limit
from avp_nerfstudio.check.pictures.evidence import check_pictures, judge
from avp_nerfstudio.check.pictures.matching import match_pictures
from avp_nerfstudio.check.pictures.rays import Stacked, estimate_relative_poses

POSES = walk_poses()
ALL = np.ones(len(POSES), bool)


@pytest.fixture(scope="module")
def matches(tmp_path_factory):
    return match_pictures(write_walk(tmp_path_factory.mktemp("evidence") / "walk"), progress=False)


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    return write_wall(tmp_path_factory.mktemp("evidence") / "wall", WALKING)


@pytest.mark.parametrize(
    ("poses", "tile_m", "tiled"),
    [(TURNING, 0.4, 0.3), (TURNING, 0.25, 0.6), (WALKING, 0.25, 0.6)],
    ids=["turning", "turning before small tiles", "walking along small tiles"],
)
def test_correct_poses_before_a_wall_that_repeats_itself_pass(tmp_path, poses, tile_m, tiled):
    rollout = write_wall(tmp_path / "wall", poses, tile_m=tile_m, tiled=tiled)
    verdicts = check_pictures(rollout, progress=False)
    assert [verdict.passed for verdict in verdicts] == [True, True], [verdict.text for verdict in verdicts]
    assert verdicts[0].figures["frames_off"] == 0


def test_all_checks_of_such_a_rollout_pass(wall, tmp_path):
    verdicts, _ = check(Check(wall.folder, out=tmp_path / "out"))
    assert [verdict.name for verdict in verdicts if not verdict.passed] == []
    assert verdicts[-1].figures["rotation_median_deg"] > 0.5


def test_a_wrong_pose_before_such_a_wall_is_named_all_the_same(wall):
    wrong = [replace(view, camera_to_world=view.camera_to_world.copy()) for view in wall.frames]
    wrong[7].camera_to_world[:3, 3] += [0.05, 0.05, 0.0]
    reprojection, _ = check_pictures(replace(wall, frames=wrong), progress=False)
    assert not reprojection.passed
    assert "the pose of frame 7 looks" in str(reprojection.cause)


def test_little_evidence_and_many_frames_allow_more_by_chance():
    assert gain_limit(2, 80) > gain_limit(4, 80) > gain_limit(16, 80) > 0.1
    assert gain_limit(4, 1000) > gain_limit(4, 80) > gain_limit(4, 1)
    assert gain_limit(10_000, 80) == pytest.approx(0.1, abs=0.01)


def moved(frame, up_m):
    poses = POSES.copy()
    poses[frame, 1, 3] += up_m
    return poses


def test_no_pose_is_named_that_the_depth_proves_right(matches):
    proved = ALL.copy()
    assert "pose of frame 6 looks" in str(judge(matches, moved(6, 0.015), CAMERA)[0].cause)
    assert judge(matches, moved(6, 0.015), CAMERA, proved=proved)[0].passed
    much = judge(matches, moved(6, 0.05), CAMERA, proved=proved)[0]
    assert much.cause == "the picture of frame 6 does not fit its pose: the depth proves the poses right"
    proved[6] = False
    assert "pose of frame 6 looks" in str(judge(matches, moved(6, 0.015), CAMERA, proved=proved)[0].cause)


def test_pictures_that_were_exchanged_are_named_when_the_depth_proves_the_poses(matches):
    exchanged = POSES.copy()
    exchanged[[4, 9]] = POSES[[9, 4]]
    reprojection, _ = judge(matches, exchanged, CAMERA, proved=ALL)
    assert reprojection.cause == "the pictures of frames 4 and 9 look exchanged: the depth proves the poses right"


def test_exchanged_picture_files_are_named_by_the_whole_check(tmp_path):
    folder = write_walk(tmp_path / "walk").folder
    first, second, aside = (folder / "images" / name for name in ("frame_00004.png", "frame_00009.png", "aside"))
    first.rename(aside)
    second.rename(first)
    aside.rename(second)
    verdicts = {verdict.name: verdict for verdict in check(Check(folder, out=tmp_path / "out"))[0]}
    assert all(verdicts[name].passed for name in ("format", "depth agreement", "ICP correction"))
    assert not verdicts["reprojection"].passed
    causes = {verdict.cause for verdict in verdicts.values() if not verdict.passed}
    assert causes == {"the pictures of frames 4 and 9 look exchanged: the depth proves the poses right"}
    assert len(read_rollout(folder).frames) == len(POSES)


def turned_pairs(factors):
    """Pairs of pictures 20 degrees apart whose matches were made with the focal length times a factor; 0: no turn."""
    yaw = np.radians([20.0 if factor else 0.0 for factor in factors])
    yaw = np.concatenate([np.zeros(len(yaw)), yaw])
    poses = camera_to_world(np.zeros((len(yaw), 3)), yaw=yaw, pitch=np.zeros(len(yaw)))
    first = np.random.default_rng(0).uniform([20, 20], [200, 220], size=(30, 2))
    second = []
    for pose, factor in zip(poses[len(factors) :], factors, strict=True):
        rays = np.stack([first[:, 0] - CAMERA.cx, CAMERA.cy - first[:, 1], np.full(30, -(factor or 1) * CAMERA.fx)], 1)
        x, y, z = (rays @ pose[:3, :3]).T
        away = -(factor or 1) * CAMERA.fx / z
        second.append(np.stack([CAMERA.cx + x * away, CAMERA.cy - y * away], 1))
    count = len(factors)
    pixels = np.array([np.tile(first, (count, 1)), np.concatenate(second)])
    pair, number = np.repeat(np.arange(count), 30), np.arange(count)
    start, matched = 30 * np.arange(count + 1), np.full(count, 30)
    return Stacked(pair, number, number + count, start, matched, pixels), poses


@pytest.mark.parametrize("factor", [0.97, 0.99, 1.01, 1.03])
def test_a_focal_length_that_suits_all_pairs_is_found(factor):
    stacked, poses = turned_pairs([factor] * 20)
    assert best_focal_factor(stacked, poses, CAMERA) == pytest.approx(factor, abs=0.001)


def test_one_pair_beside_many_that_stand_still_is_no_evidence_on_the_focal_length():
    stacked, poses = turned_pairs([0.0] * 20 + [1.2])
    assert best_focal_factor(stacked, poses, CAMERA) == 1.0


def test_noise_is_no_evidence_on_the_focal_length_of_pictures_that_do_not_turn():
    """A longer focal length makes less of the same noise."""
    stacked, poses = turned_pairs([0.0] * 20)
    noise = np.random.default_rng(1).normal(0, 0.3, stacked.pixels.shape)
    walked = poses.copy()
    walked[20:, :3, 3] -= [0, 0, 0.25]
    assert best_focal_factor(replace(stacked, pixels=stacked.pixels + noise), walked, CAMERA) == 1.0


def falsified(matches, pairs):
    """Matches in which these pairs join features at random."""
    rng, found = np.random.default_rng(0), []
    for number, pair in enumerate(matches.pairs):
        rows = pair.features.copy()
        if number in pairs:
            rows[:, 1] = rng.permutation(rows[:, 1])
        found.append(replace(pair, features=rows))
    return replace(matches, pairs=found)


def test_matches_that_fit_no_proved_pose_are_false_and_no_fault_of_the_poses(matches):
    order = np.random.default_rng(0).permutation(len(matches.pairs))
    false = falsified(matches, set(order[: int(0.7 * len(order))].tolist()))
    estimated = estimate_relative_poses(replace(matches, pairs=[matches.pairs[k] for k in order[-12:]]), CAMERA)
    blind, proved = (judge(false, POSES, CAMERA, proved=p, estimated=estimated)[0] for p in (None, ALL))
    assert not blind.passed
    assert proved.passed
    assert "could not be judged" in proved.text
    shifted = np.roll(POSES, 1, axis=0)
    assert not judge(matches, shifted, CAMERA, proved=ALL)[0].passed


def test_two_false_pairs_say_nothing_against_a_proved_pose(matches):
    own = [k for k, pair in enumerate(matches.pairs) if 6 in (pair.first, pair.second)]
    kept = [k for k in range(len(matches.pairs)) if k not in own[2:]]
    few = replace(matches, pairs=[matches.pairs[k] for k in kept])
    assert "frame 6" in judge(few, moved(6, 0.08), CAMERA)[0].text
    assert judge(few, moved(6, 0.08), CAMERA, proved=ALL)[0].passed
