import json
import shutil
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio_room import ROOM, distance_to_walls, random_poses, write_room
from PIL import Image

from avp_habitat.errors import RolloutError
from avp_habitat.poses import camera_to_world, project, z_up_to_y_up
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.images import read_depth, read_rgb

pytest.importorskip("nerfstudio")

from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.depth_dataset import DepthDataset

from avp_nerfstudio.data import frames
from avp_nerfstudio.data.dataparser import AVPDataParserConfig
from avp_nerfstudio.data.frames import MOST_VIEWS, spread_order
from avp_nerfstudio.data.refusals import UnusableRolloutError

Z_UP = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0]])


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("rollouts") / "room")


@pytest.fixture
def broken(tmp_path):
    return write_room(tmp_path / "broken", frames=2, heldout=1)


def edit(folder, change):
    path = folder / "rollout.json"
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def write_known_room(folder, *, scene="a" * 64, **options):
    """A room whose rollout.json tells its scene, as collected ones do."""
    write_room(folder, **options)
    edit(folder, lambda meta: meta.update(scene={"name": f"room {scene[0]}", "sha256": scene}))
    return folder


@pytest.fixture
def pair(tmp_path):
    """Two rollouts of one scene."""
    return write_known_room(tmp_path / "one", frames=3), write_known_room(tmp_path / "two", frames=4, heldout=3)


def parse(folder, split="train", **options):
    return AVPDataParserConfig(data=folder, **options).setup().get_dataparser_outputs(split)


def to_y_up(points):
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    return z_up_to_y_up(homogeneous[..., None])[:, :3, 0]


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_poses_come_back_as_they_were_in_metres(room, scale):
    outputs = parse(room, scale=scale)
    back = outputs.transform_poses_to_original_space(outputs.cameras.camera_to_worlds, camera_convention="opengl")
    np.testing.assert_allclose(back, random_poses(6, seed=1)[:, :3], atol=1e-6)
    assert outputs.dataparser_scale == scale


def test_nothing_is_turned_moved_or_scaled_but_y_up_to_z_up(room):
    outputs = parse(room)
    assert torch.equal(outputs.dataparser_transform, Z_UP)
    assert outputs.dataparser_scale == 1.0
    heights = outputs.cameras.camera_to_worlds[:, 2, 3]
    np.testing.assert_allclose(heights, random_poses(6, seed=1)[:, 1, 3], atol=1e-6)


def test_depth_along_nerfstudios_rays_ends_on_the_walls_and_on_its_pixel(room):
    outputs, rollout = parse(room), read_rollout(room)
    rng = np.random.default_rng(0)
    for index, view in enumerate(rollout.frames):
        rows, columns = rng.integers(0, 24, 50), rng.integers(0, 32, 50)
        pixels = torch.tensor(np.stack([rows, columns], axis=1)) + 0.5
        rays = outputs.cameras.generate_rays(torch.full((50, 1), index), coords=pixels)
        along = torch.from_numpy(read_depth(view.depth)[rows, columns])[:, None] * rays.metadata["directions_norm"]
        points = to_y_up((rays.origins + rays.directions * along).numpy())
        assert distance_to_walls(points).max() < 0.005
        landed, _ = project(points, view.camera_to_world[None], rollout.intrinsics)
        assert np.abs(landed[0] - np.stack([columns + 0.5, rows + 0.5], axis=1)).max() < 0.5


def test_training_sees_the_frames_and_evaluation_the_heldout_views(room):
    train, val, test = (parse(room, split) for split in ("train", "val", "test"))
    assert [path.relative_to(room).as_posix() for path in train.image_filenames] == [
        f"images/frame_{index:05d}.png" for index in range(6)
    ]
    assert [path.relative_to(room).as_posix() for path in val.image_filenames] == [
        "heldout/images/frame_00000.png",
        "heldout/images/frame_00001.png",
    ]
    assert val.image_filenames == test.image_filenames
    assert torch.equal(val.scene_box.aabb, train.scene_box.aabb)


def test_a_subset_of_the_frames_can_be_asked_for(room):
    names = [path.name for path in parse(room, every=2, max_views=2).image_filenames]
    assert names == ["frame_00000.png", "frame_00002.png"]
    assert len(parse(room, "val", every=2, max_views=2).image_filenames) == 2


@pytest.mark.parametrize("order", ["steps", "spread", "random"])
def test_any_order_keeps_as_many_different_frames_as_asked_for(room, order):
    names = [path.name for path in parse(room, max_views=4, order=order).image_filenames]
    assert len(names) == len(set(names)) == 4
    assert [path.name for path in parse(room, order=order).image_filenames] == sorted(
        path.name for path in (room / "images").iterdir()
    )
    assert names == [path.name for path in parse(room, max_views=4, order=order).image_filenames]
    assert names[0] == "frame_00000.png" or order == "random"
    assert names != sorted(path.name for path in (room / "images").iterdir())[:4] or order == "steps"


def test_poses_and_depth_stay_with_their_picture_in_any_order(room):
    outputs = parse(room, max_views=4, order="random")
    every = parse(room)
    for index, path in enumerate(outputs.image_filenames):
        same = every.image_filenames.index(path)
        assert torch.equal(outputs.cameras.camera_to_worlds[index], every.cameras.camera_to_worlds[same])
        assert outputs.metadata["depth_filenames"][index] == every.metadata["depth_filenames"][same]


def test_spread_views_go_far_first_then_look_elsewhere():
    x = np.array([0.0, 0.1, 5.0, 5.1, 2.5, 0.0])
    poses = camera_to_world(np.stack([x, x * 0, x * 0], 1), yaw=np.array([0, 0, 0, 0, 0, np.pi]), pitch=x * 0)
    assert spread_order(poses, 4).tolist() == [0, 3, 4, 5]
    assert sorted(spread_order(poses, 6)) == list(range(6))
    assert sorted(spread_order(np.repeat(poses[:1], 5, axis=0), 5)) == list(range(5))


def test_merged_rollouts_train_with_all_frames_and_evaluate_on_the_first_ones_heldout_views(pair):
    one, two = pair
    train, val = (parse(one, split, also=(two / "rollout.json",)) for split in ("train", "val"))
    folders = [path.parent.parent for path in train.image_filenames]
    assert folders == [one] * 3 + [two] * 4
    assert {path.parent.parent for path in train.metadata["depth_filenames"]} == {one, two}
    assert [path.relative_to(one).parts[0] for path in val.image_filenames] == ["heldout"] * 2
    alone = parse(two).cameras.camera_to_worlds
    assert torch.equal(train.cameras.camera_to_worlds[3:], alone)
    low, high = train.scene_box.aabb
    assert ((alone[:, :, 3] > low) & (alone[:, :, 3] < high)).all()


def test_rollouts_of_different_scenes_are_not_merged(pair, tmp_path):
    other = write_known_room(tmp_path / "other", scene="b" * 64, frames=1)
    text = r"other: captured in a scene of sha256 bbb.*one in a scene of sha256 aaa.*only rollouts of one scene"
    with pytest.raises(RolloutError, match=text):
        parse(pair[0], also=(pair[1], other))
    edit(other, lambda meta: meta.update(scene=None))
    with pytest.raises(RolloutError, match=r"rollout\.json: expected scene\.sha256"):
        parse(pair[0], also=(other,))


@pytest.mark.parametrize("lies", [{"origin": [448000.0, 0.0, -5411000.0]}, {"up": "z"}])
def test_rollouts_of_one_scene_that_lie_differently_are_not_merged(pair, lies):
    edit(pair[1], lambda meta: meta["scene"].update(lies))
    with pytest.raises(
        RolloutError, match=r"two: its scene lies at origin \[.*one at origin \[0\.0, 0\.0, 0\.0\] with the"
    ):
        parse(pair[0], also=(pair[1],))


def test_rollouts_of_different_cameras_are_not_merged(pair, tmp_path):
    wide = write_known_room(tmp_path / "wide", frames=1, width=40)
    text = r"wide/rollout\.json: expected the camera of .*one/rollout\.json, .*width=32.*found .*width=40.*--width 32"
    with pytest.raises(RolloutError, match=text):
        parse(pair[0], also=(wide,))
    edit(pair[1], lambda meta: meta["camera"].update(fx=meta["camera"]["fx"] * 1.03))
    with pytest.raises(RolloutError, match=r"fx=16\.64, .*found.* fx=17\.139"):
        parse(pair[0], also=(pair[1],))


def test_a_rollout_named_twice_is_refused(pair, tmp_path):
    (tmp_path / "link").symlink_to(pair[0])
    with pytest.raises(RolloutError, match=r"link: expected each rollout once"):
        parse(pair[0], also=(pair[1], tmp_path / "link"))


def test_a_fault_of_a_merged_rollout_names_its_file(pair):
    (pair[1] / "poses/frame_00003.txt").unlink()
    with pytest.raises(RolloutError, match=r"two/poses/frame_00003\.txt: expected this file"):
        parse(pair[0], also=(pair[1],))


def test_without_depth_methods_see_neither_depth_nor_points_but_the_same_box(room):
    colours, everything = parse(room, depth=False), parse(room)
    assert colours.metadata == {"metres_to_scene": 1.0}
    assert torch.equal(colours.scene_box.aabb, everything.scene_box.aabb)
    assert parse(room, "val", depth=False).metadata == {"metres_to_scene": 1.0}


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_initial_points_lie_on_the_walls_in_their_colours(room, scale):
    metadata = parse(room, scale=scale, initial_points=300).metadata
    points, colours = metadata["points3D_xyz"], metadata["points3D_rgb"]
    assert (points.dtype, colours.dtype) == (torch.float32, torch.uint8)
    assert points.shape == colours.shape == (300, 3)
    points = to_y_up(points.numpy() / scale)
    assert distance_to_walls(points).max() < 0.005
    view = read_rollout(room).frames[0]
    pixels, depth = project(points, view.camera_to_world[None], read_rollout(room).intrinsics)
    column, row = np.floor(pixels[0]).astype(int).T
    inside = (depth[0] > 0) & (column >= 0) & (column < 32) & (row >= 0) & (row < 24)
    assert inside.sum() > 20
    found = read_rgb(view.image)[row[inside], column[inside]].astype(int)
    # A convex room hides nothing, so each point seen here has the colour of its pixel, nearly.
    assert np.median(np.abs(found - colours.numpy()[inside])) <= 4


def test_initial_points_are_for_training_only_can_be_left_out_and_are_the_same_every_time(room):
    assert "points3D_xyz" not in parse(room, "val").metadata
    assert "points3D_xyz" not in parse(room, initial_points=0).metadata
    assert torch.equal(parse(room).metadata["points3D_xyz"], parse(room).metadata["points3D_xyz"])


def test_a_rollout_that_saw_nothing_has_no_points_and_its_cameras_in_the_box(broken):
    for view in read_rollout(broken).frames:
        Image.fromarray(np.zeros((24, 32), np.uint16)).save(view.depth)
    outputs = parse(broken)
    assert "points3D_xyz" not in outputs.metadata
    positions = outputs.cameras.camera_to_worlds[:, :, 3]
    expected = torch.stack([positions.amin(0) - 0.1, positions.amax(0) + 0.1])
    torch.testing.assert_close(outputs.scene_box.aabb, expected)


def test_the_scene_box_is_the_room_with_its_cameras(room):
    low, high = parse(room).scene_box.aabb.numpy()
    turned = ROOM @ Z_UP[:, :3].numpy().T
    expected = np.stack([turned.min(axis=0), turned.max(axis=0)])
    assert np.abs(np.stack([low, high]) - expected).max() < 0.25
    cameras = parse(room, "val").cameras.camera_to_worlds[:, :, 3].numpy()
    assert ((cameras > low) & (cameras < high)).all()
    np.testing.assert_allclose(parse(room, scale=0.5).scene_box.aabb, np.stack([low, high]) / 2, atol=1e-6)


def test_the_margin_of_the_scene_box_can_be_chosen(room):
    low, high = parse(room, box_margin_m=0.0).scene_box.aabb
    wide = parse(room, box_margin_m=0.5, scale=2.0).scene_box.aabb
    torch.testing.assert_close(wide, 2 * torch.stack([low - 0.5, high + 0.5]))


def test_nerfstudio_reads_depth_in_the_units_of_the_poses(room):
    for scale in (1.0, 0.5):
        outputs = parse(room, scale=scale)
        depth = DepthDataset(outputs)[0]["depth_image"][..., 0] / outputs.dataparser_scale
        np.testing.assert_allclose(depth, read_depth(outputs.metadata["depth_filenames"][0]), atol=1e-3)


def test_the_folder_opens_in_nerfstudios_own_parser_with_the_same_cameras(room):
    own = NerfstudioDataParserConfig(data=room, orientation_method="none", center_method="none", auto_scale_poses=False)
    for split in ("train", "val"):
        theirs, ours = own.setup().get_dataparser_outputs(split), parse(room, split)
        assert theirs.image_filenames == ours.image_filenames
        turned = torch.einsum("ij,njk->nik", Z_UP[:, :3], theirs.cameras.camera_to_worlds)
        np.testing.assert_allclose(ours.cameras.camera_to_worlds, turned, atol=1e-6)
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            assert torch.equal(getattr(ours.cameras, name), getattr(theirs.cameras, name)), name


def test_a_rollout_json_names_its_folder(room):
    assert len(parse(room / "rollout.json").image_filenames) == 6


@pytest.mark.parametrize(
    ("path", "content", "text"),
    [
        ("images/frame_00001.png", None, "images/frame_00001.png: expected this file"),
        ("depth/frame_00000.png", b"no picture", "depth/frame_00000.png: expected a 16-bit"),
        ("poses/frame_00001.txt", b"nan " * 16, "poses/frame_00001.txt: not a rigid camera_to_world: .*NaN"),
        ("heldout/poses/frame_00000.txt", b"1 2 3", "heldout/poses/frame_00000.txt: expected 4 rows"),
        ("rollout.json", b"{", "rollout.json: expected JSON"),
    ],
)
def test_a_damaged_rollout_is_an_error_that_names_the_file(broken, path, content, text):
    if content is None:
        (broken / path).unlink()
    else:
        (broken / path).write_bytes(content)
    with pytest.raises(RolloutError, match=text):
        parse(broken)


def damage(path):
    """Change one bit in the middle of a picture, which neither its first nor its last bytes show."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("path", ["images/frame_00001.png", "depth/frame_00000.png", "heldout/images/frame_00000.png"])
def test_a_damaged_picture_is_named_before_training(broken, path):
    damage(broken / path)
    with pytest.raises(RolloutError, match=f"{path}: expected an undamaged PNG"):
        parse(broken)


def test_many_pictures_are_checked_only_when_asked_for(broken, monkeypatch):
    # A held-out picture, because a few of the captured ones are decoded while parsing.
    damage(broken / "heldout/images/frame_00000.png")
    monkeypatch.setattr(frames, "AUTOMATIC_BYTES", 1000)
    parse(broken)
    with pytest.raises(RolloutError, match="expected an undamaged PNG"):
        parse(broken, verify=True)
    monkeypatch.setattr(frames, "AUTOMATIC_BYTES", 1_000_000)
    parse(broken, verify=False)


def test_pictures_that_are_not_used_are_not_checked(broken):
    damage(broken / "images/frame_00001.png")
    assert len(parse(broken, max_views=1).image_filenames) == 1


def test_a_picture_that_cannot_be_decoded_is_named(broken):
    damage(broken / "depth/frame_00000.png")
    with pytest.raises(RolloutError, match=r"depth/frame_00000\.png: expected a readable PNG, could not decode it"):
        parse(broken, verify=False)


def test_of_a_long_rollout_few_pictures_are_decoded_and_it_is_read_once_for_all_splits(tmp_path, monkeypatch):
    folder = write_room(tmp_path / "long", width=8, height=6, frames=3 * MOST_VIEWS)
    opened = []
    monkeypatch.setattr(
        Image, "open", lambda path, real=Image.open, **options: opened.append(path) or real(path, **options)
    )
    parser = AVPDataParserConfig(data=folder, verify=False).setup()
    train = parser.get_dataparser_outputs("train")
    assert len(opened) == len(set(opened)) == 2 * MOST_VIEWS
    shutil.rmtree(folder)
    assert len(parser.get_dataparser_outputs("val").image_filenames) == 2
    assert len(train.image_filenames) == 3 * MOST_VIEWS
    assert len(opened) == 2 * MOST_VIEWS


@pytest.mark.slow
def test_ten_thousand_frames_parse_in_three_seconds_of_work_and_little_memory(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent / "benchmarks"))
    from dataparser import lengthened

    folder = tmp_path / "long"
    lengthened(write_room(tmp_path / "room", frames=5), folder, 10_000)

    def parse_both():
        # Of so many pictures of a usual size none but a few are decoded without being asked for.
        parser = AVPDataParserConfig(data=folder, verify=False).setup()
        return [parser.get_dataparser_outputs(split) for split in ("train", "val")]

    parse(tmp_path / "room")  # the first cameras of a process make torch import for seconds
    before = time.process_time()
    train, val = parse_both()
    assert time.process_time() - before < 3
    assert (len(train.image_filenames), len(val.image_filenames)) == (10_000, 2)
    tracemalloc.start()
    parse_both()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 50e6


def test_a_rollout_without_heldout_views_says_how_to_get_them(broken):
    for kind in ("images", "depth", "poses"):
        for file in (broken / "heldout" / kind).iterdir():
            file.unlink()
    edit(broken, lambda meta: meta["counts"].update(heldout=0))
    edit(broken, lambda meta: meta.update(scene={"name": "a room.glb"}))
    assert parse(broken).image_filenames
    text = (
        r"no command adds them .* collect it again with `python -m avp_habitat\.collect --scene 'a room\.glb' --policy"
    )
    with pytest.raises(RolloutError, match=f"expected held-out views for the val split, found none.*{text}"):
        parse(broken, "val")


def test_an_unknown_split_is_refused(room):
    with pytest.raises(RolloutError, match="unknown split 'trian': expected one of train, val, test"):
        parse(room, "trian")


def test_a_rollout_without_frames_cannot_be_trained_on(broken):
    for kind in ("images", "depth", "poses"):
        for file in (broken / kind).iterdir():
            file.unlink()
    edit(broken, lambda meta: meta["counts"].update(frames=0))
    with pytest.raises(RolloutError, match="expected at least one captured frame, found none"):
        parse(broken)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"scale": 0.0}, "scale: expected a number from 1e-06 to .*, got 0.0"),
        ({"scale": float("nan")}, "scale: expected .*, got nan"),
        ({"every": 0}, "every: expected a whole number from 1"),
        ({"max_views": -1}, "max_views: expected a whole number from 0 .*, got -1"),
        ({"initial_points": -1}, "initial_points: expected"),
        ({"box_margin_m": -0.1}, "box_margin_m: expected"),
        ({"order": "backwards"}, "unknown order 'backwards': expected one of random, spread, steps"),
        ({"data": Path()}, "no rollout named; add --data"),
    ],
)
def test_impossible_options_are_refused(room, options, text):
    with pytest.raises(RolloutError, match=text):
        AVPDataParserConfig(**{"data": room, **options}).setup().get_dataparser_outputs()


def test_an_unusable_rollout_ends_a_program_with_one_line():
    error = UnusableRolloutError("it is torn")
    assert isinstance(error, SystemExit)
    assert error.code == "error: it is torn"
