import json
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio_room import ROOM, distance_to_walls, random_poses, write_room

from avp_habitat.errors import RolloutError
from avp_habitat.images import read_depth
from avp_habitat.poses import project, z_up_to_y_up
from avp_habitat.rollout import read_rollout

pytest.importorskip("nerfstudio")

from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.data.datasets.depth_dataset import DepthDataset

from avp_nerfstudio.dataparser import AVPDataParserConfig, UnusableRolloutError

Z_UP = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0]])


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("rollouts") / "room")


@pytest.fixture
def broken(tmp_path):
    return write_room(tmp_path / "broken", frames=2, heldout=1)


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


def test_the_scene_box_is_the_room_with_its_cameras(room):
    low, high = parse(room).scene_box.aabb.numpy()
    turned = ROOM @ Z_UP[:, :3].numpy().T
    expected = np.stack([turned.min(axis=0), turned.max(axis=0)])
    assert np.abs(np.stack([low, high]) - expected).max() < 0.25
    cameras = parse(room, "val").cameras.camera_to_worlds[:, :, 3].numpy()
    assert ((cameras > low) & (cameras < high)).all()
    np.testing.assert_allclose(parse(room, scale=0.5).scene_box.aabb, np.stack([low, high]) / 2, atol=1e-6)


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


def test_a_depth_picture_cut_short_is_an_error_that_names_the_file(broken):
    path = broken / "depth/frame_00000.png"
    path.write_bytes(path.read_bytes()[:-60])
    with pytest.raises(RolloutError, match=r"frame_00000\.png: expected a readable PNG"):
        parse(broken)


def test_a_rollout_without_heldout_views_cannot_be_evaluated(broken):
    for kind in ("images", "depth", "poses"):
        for file in (broken / "heldout" / kind).iterdir():
            file.unlink()
    meta = json.loads((broken / "rollout.json").read_text())
    meta["counts"]["heldout"] = 0
    (broken / "rollout.json").write_text(json.dumps(meta))
    assert parse(broken).image_filenames
    with pytest.raises(RolloutError, match="at least one view for the val split"):
        parse(broken, "val")


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"scale": 0.0}, "expected --scale above 0"),
        ({"every": 0}, "--every of at least 1"),
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
