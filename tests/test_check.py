import json
import shutil

import numpy as np
import open3d
import pytest
from check_rollout import SPIN, write_walk
from pose_faults import FAULTS, Fault, write_faulty
from rrd import entities, verify
from scipy.spatial.transform import Rotation

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.poses import y_up_to_z_up
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.images import read_depth
from avp_habitat.scenes.loader import load_scene
from avp_nerfstudio.check.__main__ import main
from avp_nerfstudio.check.depth_maps import load_depth_maps
from avp_nerfstudio.check.geometry import check_geometry
from avp_nerfstudio.check.outputs import choose_folder
from avp_nerfstudio.check.shape import check_format


@pytest.fixture(scope="module")
def correct(tmp_path_factory):
    return write_walk(tmp_path_factory.mktemp("check") / "correct", heldout=2)


@pytest.fixture
def copy(correct, tmp_path):
    return shutil.copytree(correct, tmp_path / "copy")


def edit_json(path, change):
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def format_of(folder):
    _, verdict = check_format(folder)
    return verdict


def test_a_correct_rollout_has_the_right_format(correct):
    rollout, verdict = check_format(correct)
    assert rollout is not None
    assert verdict.passed
    assert verdict.figures == {"views": 18, "faults": 0}


def test_a_fault_of_the_folder_is_a_failed_verdict_that_names_the_file(copy):
    (copy / "poses" / "frame_00003.txt").write_text("1 0 0 0\n")
    assert not format_of(copy).passed
    assert "frame_00003.txt: expected 4 rows of 4 numbers, found 4 numbers" in format_of(copy).text


def test_a_focal_length_that_does_not_fit_the_field_of_view_is_named(copy):
    edit_json(copy / "rollout.json", lambda meta: meta["camera"].update(hfov_deg=80.0))
    assert "fx is 80.00 pixels, expected 95.34 from 160 pixels and 80 degrees" in format_of(copy).text


def test_a_principal_point_of_the_swapped_picture_is_named(copy):
    edit_json(copy / "rollout.json", lambda meta: meta["camera"].update(cx=60.0, cy=80.0))
    edit_json(copy / "transforms.json", lambda transforms: transforms.update(cx=60.0, cy=80.0))
    verdict = format_of(copy)
    assert "principal point (60, 80) is the middle of 120x160" in verdict.text
    assert verdict.cause == "width and height look swapped"


def test_transforms_that_tell_another_pose_are_named(copy):
    def move(transforms):
        transforms["frames"][5]["transform_matrix"][0][3] += 0.01

    edit_json(copy / "transforms.json", move)
    assert "transforms.json has another pose for images/frame_00005.png" in format_of(copy).text


def test_transforms_with_another_focal_length_are_named(copy):
    edit_json(copy / "transforms.json", lambda transforms: transforms.update(fl_x=81.0))
    assert "transforms.json says fl_x = 81.0, rollout.json 80" in format_of(copy).text


def test_a_table_of_steps_that_tells_another_position_is_named(copy):
    path = copy / "steps.csv"
    lines = path.read_text().splitlines()
    column = lines[0].split(",").index("y_m")
    cells = lines[8].split(",")
    cells[column] = str(float(cells[column]) + 0.1)
    lines[8] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")
    assert "frame 7 stands 100 mm from its position in steps.csv" in format_of(copy).text


def test_a_table_of_steps_without_a_column_is_named(copy):
    path = copy / "steps.csv"
    path.write_text(path.read_text().replace("yaw_rad", "yaw"))
    assert "steps.csv: expected a column 'yaw_rad', found none" in format_of(copy).text


def test_a_world_with_z_up_is_named(correct, tmp_path):
    fault = Fault("z up", lambda right, _: type(right)(*map(y_up_to_z_up, right_poses(right)), right.intrinsics), "")
    verdict = format_of(write_faulty(correct, tmp_path / "faulty", fault))
    assert verdict.cause == "the world looks Z-up, as nerfstudio's is: expected Y up"


def right_poses(right):
    return right.frames, right.heldout


def test_rolled_cameras_are_counted(correct, tmp_path):
    def roll(right, _):
        frames = right.frames.copy()
        frames[4, :3, :3] = frames[4, :3, :3] @ Rotation.from_rotvec([0.0, 0.0, 0.1]).as_matrix()
        return type(right)(frames, right.heldout, right.intrinsics)

    verdict = format_of(write_faulty(correct, tmp_path / "faulty", Fault("roll", roll, "")))
    assert "1 of 18 cameras do not stand upright, frame 4 is rolled to the side" in verdict.text


def test_thinned_depth_is_the_depth_at_its_pixels(correct):
    rollout = read_rollout(correct)
    maps = load_depth_maps(rollout.frames[:2], rollout.intrinsics)
    depth = read_depth(rollout.frames[1].depth)
    rng = np.random.default_rng(0)
    rows, columns = rng.integers(5, 110, 200), rng.integers(5, 150, 200)
    found, smooth = maps.look_up(1, np.stack([columns + 0.5, rows + 0.5], axis=1))
    assert smooth.sum() > 100
    np.testing.assert_allclose(found[smooth], depth[rows, columns][smooth], atol=1e-3)


def test_interpolated_depth_of_a_slanted_wall_is_exact(correct):
    rollout = read_rollout(correct)
    maps = load_depth_maps(rollout.frames[:1], rollout.intrinsics)
    plane = 1 / (0.3 + 0.002 * np.arange(160)[None] + 0.001 * np.arange(120)[:, None])
    flat = type(maps)(1, (1 / plane[None]).astype(np.float32), np.ones((1, 119, 159), bool), maps.samples, maps.counts)
    found, _ = flat.look_up(0, np.array([[30.25, 40.75], [100.5, 80.0]]))
    expected = [1 / (0.3 + 0.002 * 29.75 + 0.001 * 40.25), 1 / (0.3 + 0.002 * 100 + 0.001 * 79.5)]
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_mesh_is_where_the_depth_says(correct):
    geometry = check_geometry(read_rollout(correct), load_scene("builtin:0"))
    verdict = geometry.verdicts[-1]
    assert verdict.name == "mesh distance"
    assert verdict.passed
    assert verdict.figures["p95_mm"] < 2


def test_another_mesh_is_found_to_be_another(correct):
    verdict = check_geometry(read_rollout(correct), load_scene("builtin:1")).verdicts[-1]
    assert not verdict.passed
    assert verdict.cause == "builtin:1 is not the scene in which the rollout was captured"


def test_a_whole_world_that_is_moved_shows_in_the_mesh_alone(correct, tmp_path):
    def lift(right, _):
        moved = [poses.copy() for poses in right_poses(right)]
        for poses in moved:
            poses[:, 1, 3] += 0.1
        return type(right)(*moved, right.intrinsics)

    folder = write_faulty(correct, tmp_path / "faulty", Fault("lifted", lift, ""))
    geometry = check_geometry(read_rollout(folder), load_scene("builtin:0"))
    assert [v.name for v in geometry.verdicts if not v.passed] == ["mesh distance"]
    assert "the world of the poses is not that of the mesh" in geometry.verdicts[-1].cause


def test_turning_in_place_is_said_to_hide_the_scale(tmp_path):
    verdict = check_geometry(read_rollout(write_walk(tmp_path / "spin", SPIN, heldout=0))).verdicts[0]
    assert verdict.passed
    assert "these views cannot show a scale that is wrong by 10 %" in verdict.text


def test_a_single_frame_passes_and_says_that_nothing_was_compared(tmp_path):
    geometry = check_geometry(read_rollout(write_walk(tmp_path / "one", SPIN[:1], heldout=0)))
    assert geometry.verdicts[0].passed
    assert "nothing is seen in two pictures" in geometry.verdicts[0].text


def test_the_command_writes_report_picture_cloud_and_recording(correct, tmp_path, capsys):
    out = tmp_path / "results"
    assert command.run(main, [str(correct), "--mesh", "builtin:0", "--out", str(out), "--no-pictures"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("PASS") == 4
    assert f"results: {out}" in printed
    report = json.loads((out / "check.json").read_text())
    assert report["passed"] is True
    assert [v["name"] for v in report["verdicts"]] == ["format", "depth agreement", "ICP correction", "mesh distance"]
    assert sorted(path.name for path in out.iterdir()) == ["check.json", "check.rrd", "cloud.ply", "overview.png"]
    cloud = open3d.io.read_point_cloud(str(out / "cloud.ply"))
    assert len(cloud.points) > 1000
    assert cloud.has_colors()
    verify(out / "check.rrd")
    assert entities(out / "check.rrd") >= {"/world/cloud", "/world/frusta", "/world/camera/picture"}


def test_the_command_ends_with_1_and_names_the_failed_checks(correct, tmp_path, capsys):
    folder = write_faulty(correct, tmp_path / "faulty", FAULTS[0])
    assert command.run(main, [str(folder), "--no-pictures"]) == 1
    printed = capsys.readouterr()
    assert "likely cause: camera axes look like opencv written as habitat: y and z flipped" in printed.out
    assert "2 of 3 checks failed: format, depth agreement" in printed.err
    assert json.loads((tmp_path / "faulty-check" / "check.json").read_text())["passed"] is False


def test_an_unreadable_rollout_gets_a_report_and_exit_code_1(copy, capsys):
    (copy / "images" / "frame_00002.png").unlink()
    assert command.run(main, [str(copy)]) == 1
    assert "frame_00002.png: expected this file" in capsys.readouterr().out
    assert [p.name for p in copy.with_name("copy-check").iterdir()] == ["check.json"]


def test_a_second_check_replaces_its_own_files_only(copy, tmp_path):
    out = tmp_path / "results"
    argv = [str(copy), "--out", str(out), "--no-pictures"]
    assert command.run(main, argv) == 0
    (out / "notes.txt").write_text("mine")
    before = (out / "check.json").read_text()
    edit_json(copy / "rollout.json", lambda meta: meta["camera"].update(hfov_deg=80.0))
    assert command.run(main, argv) == 1
    assert (out / "check.json").read_text() != before
    assert (out / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("out", "complaint"),
    [("copy/results", "outside the rollout"), ("full", "holds other files"), ("file", "found a file")],
)
def test_results_are_not_written_where_they_do_not_belong(copy, tmp_path, out, complaint):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "check.json").write_text('{"format": "mine"}')
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=complaint):
        choose_folder(copy, tmp_path / out)


@pytest.mark.parametrize(
    "argv", [["nowhere"], ["{copy}", "--mesh", "room.txt"], ["{copy}", "--export-colmap", "{copy}"]]
)
def test_wrong_options_end_with_2(copy, capsys, argv):
    assert command.run(main, [word.format(copy=copy) for word in argv]) == 2
    assert capsys.readouterr().err.count("\n") == 1
