import json
import shutil

import numpy as np
import pytest
from corridor import Corridor
from PIL import Image

from avp_habitat import poses
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import images
from avp_habitat.rollout.capture import capture_step, publish_rollout
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.images import check_png_contents
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.task.env import AVPEnv

CAMERA = Intrinsics.from_hfov(12, 8, hfov_deg=75)
FRAMES, HELDOUT = 3, 2
FLOOR = np.array([[0, 1, 2, 4], [1, 2, 3, 0], [0, 0, 1, 70]], dtype=np.uint16)


def some_poses(count):
    spread = np.arange(count)
    position = np.stack([spread * 0.25, spread * 0 + 1.5, -spread], axis=1)
    return poses.camera_to_world(position, yaw=spread * 0.3, pitch=spread * 0.1 - 0.2)


def write(folder):
    rng = np.random.default_rng(0)
    with RolloutWriter(folder, CAMERA) as writer:
        for k, pose in enumerate(some_poses(FRAMES)):
            writer.add_frame(rng.integers(0, 255, (8, 12, 3), dtype=np.uint8), rng.uniform(0.5, 9, (8, 12)), pose)
            writer.add_step({"step": k + 1, "action": "stop"})
        for pose in some_poses(HELDOUT):
            writer.add_heldout(rng.integers(0, 255, (8, 12, 3), dtype=np.uint8), rng.uniform(0.5, 9, (8, 12)), pose)
        images.write_numbers(writer.path("floor.png"), FLOOR)
        floor = {"file": "floor.png", "cell_m": 0.1, "origin_m": [-1.5, 2.25], "shape": list(FLOOR.shape)}
        about = {"seed": 3, "versions": {"avp-suite": "0.1.0"}, "camera": {"hfov_deg": 75}}
        writer.publish(about | {"floor": floor})
    return folder


@pytest.fixture
def rollout(tmp_path):
    return write(tmp_path / "r0")


def test_a_rollout_reads_back_as_it_was_written(rollout):
    found = read_rollout(rollout)
    assert found.intrinsics == CAMERA
    assert (len(found.frames), len(found.heldout)) == (FRAMES, HELDOUT)
    for view, pose in zip(found.frames, some_poses(FRAMES), strict=True):
        np.testing.assert_allclose(view.camera_to_world, pose, atol=1e-8)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(
        images.read_rgb(found.frames[0].image), rng.integers(0, 255, (8, 12, 3), dtype=np.uint8)
    )
    np.testing.assert_allclose(images.read_depth(found.frames[0].depth), rng.uniform(0.5, 9, (8, 12)), atol=0.0006)
    assert found.meta["seed"] == 3
    assert read_rollout(rollout / "rollout.json").folder == rollout


def test_transforms_json_lists_every_view_once_with_its_split(rollout):
    transforms = json.loads((rollout / "transforms.json").read_text())
    names = [frame["file_path"] for frame in transforms["frames"]]
    assert len(set(names)) == FRAMES + HELDOUT
    assert transforms["train_filenames"] + transforms["val_filenames"] == names
    assert all((rollout / name).is_file() for name in names)
    assert all((rollout / frame["depth_file_path"]).is_file() for frame in transforms["frames"])


def test_depth_is_kept_in_whole_millimetres_and_what_does_not_fit_is_none():
    stored = images.encode_depth(np.array([0.0, 0.0004, 1.2345678, 65.535, 80.0]))
    assert stored.tolist() == [0, 0, 1235, 65535, 0]


def test_an_existing_folder_is_refused_and_untouched(rollout):
    before = sorted(rollout.rglob("*"))
    with pytest.raises(UsageError, match="exists already"):
        RolloutWriter(rollout, CAMERA)
    assert sorted(rollout.rglob("*")) == before


def break_off(folder, act):
    """Write one frame of a rollout, then do something that ends the writing."""
    with RolloutWriter(folder, CAMERA) as writer:
        writer.add_frame(np.zeros((8, 12, 3), dtype=np.uint8), np.ones((8, 12)), some_poses(1)[0])
        act(writer)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interrupted_collection_leaves_nothing_behind(tmp_path, error):
    def interrupt(writer):
        raise error

    with pytest.raises(error):
        break_off(tmp_path / "r1", interrupt)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_appears_meanwhile_is_not_replaced(tmp_path):
    def collide(writer):
        (tmp_path / "r2").mkdir()
        (tmp_path / "r2" / "theirs").touch()
        writer.publish({})

    with pytest.raises(UsageError, match="another program made it"):
        break_off(tmp_path / "r2", collide)
    assert [path.name for path in tmp_path.rglob("*")] == ["r2", "theirs"]


def test_a_parent_that_is_a_file_is_one_clear_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RolloutError, match="cannot write there"):
        break_off(tmp_path / "file" / "r", lambda writer: None)


def test_a_full_disk_is_one_clear_error_and_leaves_nothing(tmp_path):
    def fill(writer):
        # /dev/full fails every write with ENOSPC, as a full disk does.
        (writer.path("images") / "frame_00001.png").symlink_to("/dev/full")
        writer.add_frame(np.zeros((8, 12, 3), dtype=np.uint8), np.ones((8, 12)), some_poses(1)[0])
        writer.publish({})

    with pytest.raises(RolloutError, match="cannot write there: No space left"):
        break_off(tmp_path / "r", fill)
    assert list(tmp_path.iterdir()) == []


def test_the_floor_reads_back_as_it_was_written(rollout):
    floor = read_rollout(rollout).floor
    assert floor is not None
    assert (floor.cell_m, floor.origin_m, floor.shape) == (0.1, (-1.5, 2.25), (3, 4))
    np.testing.assert_array_equal(images.read_numbers(floor.picture), FLOOR)


def test_a_rollout_of_before_has_no_floor(rollout):
    edit_json(rollout / "rollout.json", lambda j: j.pop("floor"))
    (rollout / "floor.png").unlink()
    found = read_rollout(rollout)
    assert found.floor is None
    assert len(found.frames) == FRAMES


def test_the_floor_counts_what_the_environment_observed(tmp_path):
    """Cells by the view that first observed them give the coverage after every view."""
    env = AVPEnv(simulator=Corridor(), budget=4, width=16, height=12)
    env.reset(seed=0)
    curve = []
    with RolloutWriter(tmp_path / "r", CAMERA) as writer:
        for action in (0, 1, 1, 0):
            _, reward, _, _, info = env.step(action)
            capture_step(env, writer, action, reward, info)
            curve.append(info["coverage"])
        publish_rollout(env, writer, info, policy={"name": "a list"}, seed=0, heldout=0)
    floor = read_rollout(tmp_path / "r").floor
    assert floor is not None
    numbers = images.read_numbers(floor.picture)
    np.testing.assert_array_equal(numbers > 0, env.area.mask)
    found = [((numbers > 1) & (numbers <= 1 + t)).sum() / (numbers > 0).sum() for t in range(1, 5)]
    assert curve[0] < curve[-1]
    np.testing.assert_allclose(found, curve)
    assert floor.cell_m == env.area.cell_m
    np.testing.assert_allclose(floor.origin_m, env.area.origin)


def edit_json(path, change):
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def flip(folder):
    path = folder / "poses/frame_00001.txt"
    np.savetxt(path, np.loadtxt(path) @ np.diag([1, -1, 1, 1]))


def resize(folder, name, size, mode):
    Image.new(mode, size).save(folder / name)


def link_out(folder, name, *, missing=False):
    """The file moves to a store that lies outside of the rollout, and a link stays."""
    store = folder.parent / "store"
    store.mkdir(exist_ok=True)
    target = store / name.replace("/", "-")
    shutil.move(folder / name, target)
    (folder / name).symlink_to(target)
    if missing:
        target.unlink()


def floor_file(folder, name):
    meta = json.loads((folder / "rollout.json").read_text())
    meta["floor"]["file"] = name
    (folder / "rollout.json").write_text(json.dumps(meta))


def cut_short(folder, name):
    path = folder / name
    path.write_bytes(path.read_bytes()[:-20])


def flip_byte(path, position):
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(content)


def link_to_itself(folder, name):
    (folder / name).unlink()
    (folder / name).symlink_to(folder / name)


def replace_by_folder(folder, name):
    (folder / name).unlink()
    (folder / name).mkdir()


DAMAGES = {
    "no folder": (shutil.rmtree, "expected a rollout folder"),
    "no rollout.json": (lambda f: (f / "rollout.json").unlink(), "rollout.json: expected this file"),
    "not json": (lambda f: (f / "rollout.json").write_text("{"), "rollout.json: expected JSON"),
    "a list": (lambda f: (f / "rollout.json").write_text("[]"), "expected a JSON object, found a list"),
    "another format": (lambda f: edit_json(f / "rollout.json", lambda j: j.update(format="x")), "expected format"),
    "another version": (
        lambda f: edit_json(f / "rollout.json", lambda j: j.update(format_version=9)),
        r"expected format version 1, found 9, written by avp-suite 0\.1\.0",
    ),
    "NaN focal length": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["camera"].update(fx=float("nan"))),
        "rollout.json: expected JSON, could not read it: Out of range float values",
    ),
    "no width": (lambda f: edit_json(f / "rollout.json", lambda j: j["camera"].pop("width")), "camera.width"),
    "wrong count": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["counts"].update(frames=2)),
        "frame_00002.png: a frame that rollout.json does not count",
    ),
    "count is text": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["counts"].update(frames="3")),
        "counts.frames to be a whole number, found '3'",
    ),
    "missing image": (lambda f: (f / "images/frame_00001.png").unlink(), "images/frame_00001.png: expected this file"),
    "missing depth": (lambda f: (f / "heldout/depth/frame_00000.png").unlink(), "heldout/depth/frame_00000.png"),
    "missing pose": (lambda f: (f / "poses/frame_00002.txt").unlink(), "poses/frame_00002.txt: expected this file"),
    "no heldout folder": (lambda f: shutil.rmtree(f / "heldout"), "heldout/images: expected 2 files"),
    "empty image": (lambda f: (f / "images/frame_00000.png").write_bytes(b""), "8-bit RGB PNG, found an empty file"),
    "a jpeg": (lambda f: Image.new("RGB", (12, 8)).save(f / "images/frame_00000.png", "JPEG"), "found something else"),
    "wrong size": (lambda f: resize(f, "images/frame_00002.png", (8, 12), "RGB"), "expected 12x8 pixels.*found 8x12"),
    "grey image": (
        lambda f: resize(f, "images/frame_00002.png", (12, 8), "L"),
        "expected an 8-bit RGB PNG, found 8 bits with PNG colour type 0",
    ),
    "8-bit depth": (lambda f: resize(f, "depth/frame_00002.png", (12, 8), "L"), "expected a 16-bit grey PNG"),
    "NaN pose": (
        lambda f: (f / "poses/frame_00001.txt").write_text("nan 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"),
        "frame_00001.txt: not a rigid camera_to_world: expected finite numbers",
    ),
    "reflected pose": (flip, "frame_00001.txt: not a rigid camera_to_world: .*reflection"),
    "short pose": (lambda f: (f / "poses/frame_00001.txt").write_text("1 2 3"), "found 3 numbers"),
    "words in a pose": (
        lambda f: (f / "poses/frame_00001.txt").write_text("one " * 16),
        "expected 4 rows of 4 numbers",
    ),
    "turned by a scale": (
        lambda f: np.savetxt(f / "poses/frame_00002.txt", np.diag([1.001, 1, 1, 1])),
        "frame_00002.txt: not a rigid camera_to_world: .*not orthonormal",
    ),
    "a pose longer than any": (
        lambda f: (f / "poses/frame_00001.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1" + " 0" * 4000),
        "expected 4 rows of 4 numbers",
    ),
    "count beyond all files": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["counts"].update(frames=10**12)),
        "frame_00003.png: expected this file",
    ),
    "a size beyond all numbers": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["camera"].update(fx=10**400)),
        "camera.fx to be a number of pixels above 0, found 1000",
    ),
    "an origin of two numbers": (
        lambda f: edit_json(f / "rollout.json", lambda j: j.update(scene={"name": "a", "origin": [1.0, 2.0]})),
        r"scene.origin to be three lengths in metres, found \[1.0, 2.0\]",
    ),
    "nested without end": (lambda f: (f / "rollout.json").write_text("[" * 100_000), "rollout.json: expected JSON"),
    "image cut short": (lambda f: cut_short(f, "images/frame_00002.png"), "frame_00002.png: .* without an end"),
    "depth cut short": (lambda f: cut_short(f, "heldout/depth/frame_00001.png"), "frame_00001.png: .* without an end"),
    "image is a folder": (
        lambda f: replace_by_folder(f, "images/frame_00001.png"),
        "frame_00001.png: .*could not read",
    ),
    "image leads to itself": (
        lambda f: link_to_itself(f, "images/frame_00001.png"),
        "frame_00001.png: .*could not read it",
    ),
    "image not fetched": (
        lambda f: link_out(f, "images/frame_00001.png", missing=True),
        "frame_00001.png: .*No such file",
    ),
    "pose not fetched": (lambda f: link_out(f, "poses/frame_00000.txt", missing=True), "expected this pose file"),
    "no floor": (lambda f: (f / "floor.png").unlink(), "floor.png: expected a 16-bit grey PNG, could not read it"),
    "floor is text": (
        lambda f: edit_json(f / "rollout.json", lambda j: j.update(floor="floor.png")),
        "floor.file to be the name of a file, found None",
    ),
    "floor not fetched": (
        lambda f: link_out(f, "floor.png", missing=True),
        r"floor\.png: .*could not read it: No such file",
    ),
    "floor outside": (lambda f: floor_file(f, "../floor.png"), r"\.\./floor\.png: expected a path inside"),
    "floor absolute": (lambda f: floor_file(f, "/etc/hostname"), r"/etc/hostname: expected a path inside"),
    "floor elsewhere": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["floor"].update(file="../floor.png")),
        r"\.\./floor.png: expected a path inside",
    ),
    "floor cut short": (lambda f: cut_short(f, "floor.png"), "floor.png: .* without an end"),
    "floor damaged": (lambda f: flip_byte(f / "floor.png", 60), "floor.png: expected an undamaged PNG"),
    "floor of another size": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["floor"].update(shape=[4, 3])),
        "floor.png: expected 3x4 pixels .*found 4x3",
    ),
    "8-bit floor": (lambda f: resize(f, "floor.png", (4, 3), "L"), "floor.png: expected a 16-bit grey PNG"),
    "floor of no shape": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["floor"].update(shape=[3, 0])),
        r"floor.shape to be rows and columns above 0, found \[3, 0\]",
    ),
    "floor nowhere": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["floor"].update(origin_m=[0, float("nan")])),
        "rollout.json: expected JSON, could not read it: Out of range float values",
    ),
    "floor of no cells": (
        lambda f: edit_json(f / "rollout.json", lambda j: j["floor"].update(cell_m=0)),
        "floor.cell_m to be metres above 0, found 0",
    ),
    "rollout.json not fetched": (
        lambda f: link_out(f, "rollout.json", missing=True),
        "rollout.json: expected this file",
    ),
}


def test_a_pose_written_with_few_digits_is_still_rigid(rollout):
    path = rollout / "poses/frame_00001.txt"
    np.savetxt(path, np.loadtxt(path).round(4), fmt="%.4f")
    written = np.loadtxt(path)
    assert 5e-5 < np.abs(written[:3, :3] @ written[:3, :3].T - np.eye(3)).max() < 1e-4
    np.testing.assert_array_equal(read_rollout(rollout).frames[1].camera_to_world, written)


def test_the_first_of_several_bad_poses_is_named(rollout):
    for index in (2, 1):
        np.savetxt(rollout / f"poses/frame_0000{index}.txt", np.diag([2.0, 1, 1, 1]))
    with pytest.raises(RolloutError, match=r"poses/frame_00001\.txt: not a rigid"):
        read_rollout(rollout)


def test_links_are_followed_within_the_folder_and_into_a_store(rollout):
    (rollout / "images/frame_00001.png").unlink()
    (rollout / "images/frame_00001.png").symlink_to(rollout / "images/frame_00000.png")
    for name in ("rollout.json", "floor.png", "depth/frame_00001.png", "poses/frame_00000.txt", "steps.csv"):
        link_out(rollout, name)
    link_out(rollout, "heldout")
    assert len(read_rollout(rollout).frames) == FRAMES


@pytest.mark.parametrize("position", [20, 33, 60, -20])
def test_any_damaged_byte_of_a_picture_is_found_by_its_checksums(rollout, position):
    path = rollout / "images/frame_00000.png"
    check_png_contents(path)
    content = bytearray(path.read_bytes())
    content[position] ^= 1
    path.write_bytes(content)
    with pytest.raises(RolloutError, match=r"frame_00000\.png: expected an undamaged PNG"):
        check_png_contents(path)


@pytest.mark.parametrize("damage", DAMAGES)
def test_every_damage_is_an_error_that_names_the_file(rollout, damage):
    spoil, words = DAMAGES[damage]
    spoil(rollout)
    with pytest.raises(RolloutError, match=words) as caught:
        read_rollout(rollout)
    assert str(rollout) in str(caught.value)
