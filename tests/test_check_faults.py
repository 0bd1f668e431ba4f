import re

import numpy as np
import pytest
from check_rollout import write_walk
from pose_faults import FAULTS, MORE_FAULTS, Fault, write_faulty

from avp_habitat.rollout.format import read_rollout
from avp_nerfstudio.check.geometry import check_geometry
from avp_nerfstudio.check.shape import check_format

GEOMETRIC = [fault for fault in (*FAULTS, *MORE_FAULTS) if "swapped" not in fault.name]
SWAPPED = next(fault for fault in FAULTS if "swapped" in fault.name)


@pytest.fixture(scope="module")
def correct(tmp_path_factory):
    return write_walk(tmp_path_factory.mktemp("check") / "correct")


def failed(geometry):
    return [verdict.name for verdict in geometry.verdicts if not verdict.passed]


def cause_of(geometry):
    return next(verdict.cause for verdict in geometry.verdicts if not verdict.passed)


def test_a_correct_rollout_passes(correct):
    _, verdict = check_format(correct)
    assert verdict.passed, verdict.text
    geometry = check_geometry(read_rollout(correct))
    assert failed(geometry) == []
    assert geometry.diagnosis is None
    assert geometry.verdicts[0].figures["agreeing_2cm_percent"] > 99.9
    assert geometry.verdicts[1].figures["registered_frames"] == 20


def test_there_are_ten_faults():
    assert len({fault.name for fault in FAULTS}) == 10


@pytest.mark.parametrize("fault", GEOMETRIC, ids=lambda fault: fault.name)
def test_a_fault_is_caught_and_named_by_the_depth_alone(correct, tmp_path, fault):
    geometry = check_geometry(read_rollout(write_faulty(correct, tmp_path / "faulty", fault, seed=1)))
    assert "depth agreement" in failed(geometry)
    assert re.search(fault.named, cause_of(geometry)), cause_of(geometry)
    others = [other.name for other in GEOMETRIC if other != fault and re.search(other.named, cause_of(geometry))]
    assert others == []


def test_swapped_width_and_height_are_named_by_the_format(correct, tmp_path):
    rollout, verdict = check_format(write_faulty(correct, tmp_path / "faulty", SWAPPED))
    assert rollout is None
    assert not verdict.passed
    assert re.search(SWAPPED.named, verdict.cause)
    assert "120x160" in verdict.cause
    assert "160x120" in verdict.cause


def test_the_source_of_a_damaged_copy_stays_as_it_is(correct, tmp_path):
    before = {path: path.read_bytes() for path in correct.rglob("*") if path.is_file()}
    write_faulty(correct, tmp_path / "faulty", FAULTS[0])
    assert {path: path.read_bytes() for path in correct.rglob("*") if path.is_file()} == before


def exchanged(a, b):
    def damage(right, _):
        frames = right.frames.copy()
        frames[[a, b]] = right.frames[[b, a]]
        return type(right)(frames, right.heldout, right.intrinsics)

    return Fault("exchanged", damage, "")


def off(frame, offset):
    def damage(right, _):
        frames = right.frames.copy()
        frames[frame, :3, 3] += offset
        return type(right)(frames, right.heldout, right.intrinsics)

    return Fault("off", damage, "")


def test_exchanged_poses_are_named_by_both_numbers(correct, tmp_path):
    geometry = check_geometry(read_rollout(write_faulty(correct, tmp_path / "faulty", exchanged(3, 11))))
    assert cause_of(geometry) == "the poses of frame 3 and frame 11 are exchanged"


def test_a_pose_that_is_off_is_named_with_its_offset(correct, tmp_path):
    offset = np.array([0.0, 0.05, 0.0])
    geometry = check_geometry(read_rollout(write_faulty(correct, tmp_path / "faulty", off(6, offset))))
    assert np.flatnonzero(geometry.bad).tolist() == [6]
    assert re.search(r"the pose of frame 6 is off by 5\d mm .*y \+5\d", cause_of(geometry)), cause_of(geometry)


def test_a_step_to_the_side_is_impossible_even_where_no_depth_shows_it(correct, tmp_path):
    folder = write_faulty(correct, tmp_path / "faulty", off(4, np.array([0.03, 0.0, 0.04])))
    _, verdict = check_format(folder)
    assert not verdict.passed
    assert "of 0.050 m (at most 0 m)" in verdict.text
    assert verdict.cause == "the pose of frame 4 is off: the steps to it and from it are impossible"


def test_a_mistake_in_the_held_out_views_alone_is_said_to_be_theirs(correct, tmp_path):
    def damage(right, rng):
        return type(right)(right.frames, FAULTS[0].damage(right, rng).heldout, right.intrinsics)

    fault = Fault("half", damage, "")
    geometry = check_geometry(read_rollout(write_faulty(correct, tmp_path / "faulty", fault)))
    assert cause_of(geometry).endswith("y and z flipped (of the held-out views alone)")


def test_a_mistake_that_is_not_known_is_admitted(correct, tmp_path):
    def damage(right, rng):
        frames = right.frames.copy()
        frames[:, :3, 3] += rng.normal(scale=0.3, size=(len(frames), 3))
        return type(right)(frames, right.heldout, right.intrinsics)

    geometry = check_geometry(read_rollout(write_faulty(correct, tmp_path / "faulty", Fault("noise", damage, ""))))
    assert "none of the known mistakes explains it" in cause_of(geometry)


def test_every_frame_that_shows_enough_is_proved_right_but_one_that_is_off(correct, tmp_path):
    right = check_geometry(read_rollout(correct), explain=False)
    wrong = check_geometry(
        read_rollout(write_faulty(correct, tmp_path / "faulty", off(6, np.array([0.0, 0.02, 0.0])))), explain=False
    )
    assert right.proved[6]
    assert right.proved.mean() > 0.5
    assert not wrong.proved[6]
    assert not all(verdict.passed for verdict in wrong.verdicts)
