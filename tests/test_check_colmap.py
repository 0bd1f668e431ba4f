import numpy as np
import pycolmap
import pytest
from picture_walk import walk_poses, write_walk

from avp_habitat.collect import Collect, collect
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.poses import habitat_to_opencv
from avp_habitat.rollout.format import read_rollout
from avp_habitat.task.settings import TaskSettings
from avp_nerfstudio.check import colmap
from avp_nerfstudio.check.colmap import SPARSE, export_colmap
from avp_nerfstudio.check.pictures.evidence import check_pictures
from avp_nerfstudio.check.pictures.matching import match_pictures


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return write_walk(tmp_path_factory.mktemp("colmap") / "walk")


@pytest.fixture(scope="module")
def exported(walk, tmp_path_factory):
    return export_colmap(walk, tmp_path_factory.mktemp("exported") / "model", progress=False)


def parsed(folder, **options):
    from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    config = ColmapDataParserConfig(
        data=folder, orientation_method="none", center_method="none", auto_scale_poses=False, eval_mode="all", **options
    )
    return config.setup().get_dataparser_outputs("train")


def homogeneous(matrices):
    return np.concatenate([matrices, np.broadcast_to([[[0, 0, 0, 1.0]]], (len(matrices), 1, 4))], axis=1)


def test_pycolmap_reads_the_poses_and_the_camera_as_they_were(exported):
    model = pycolmap.Reconstruction(exported / SPARSE)
    assert model.num_reg_images() == 14
    expected = np.linalg.inv(habitat_to_opencv(walk_poses()))[:, :3]
    found = [model.images[index + 1].cam_from_world().matrix() for index in range(14)]
    np.testing.assert_allclose(found, expected, atol=1e-8)
    assert [model.images[index + 1].name for index in range(14)] == [f"frame_{index:05d}.png" for index in range(14)]
    (camera,) = model.cameras.values()
    assert (camera.width, camera.height) == (320, 240)
    np.testing.assert_allclose(camera.params, [160, 160, 160, 120])


def test_the_points_fit_their_pictures_and_have_tracks_and_colours(exported):
    model = pycolmap.Reconstruction(exported / SPARSE)
    model.update_point_3d_errors()
    assert model.num_points3D() > 300
    assert 0 < model.compute_mean_reprojection_error() < 0.5
    assert model.compute_mean_track_length() > 3
    colours = np.array([point.color for point in model.points3D.values()])
    assert colours.std() > 5
    point = next(iter(model.points3D.values()))
    seen = point.track.elements[0]
    image = model.images[seen.image_id]
    np.testing.assert_allclose(image.project_point(point.xyz), image.points2D[seen.point2D_idx].xy, atol=4)


def test_the_pictures_lie_beside_the_model(walk, exported):
    names = sorted(path.name for path in (exported / "images").iterdir())
    assert names == [view.image.name for view in walk.frames]
    assert (exported / "images" / names[3]).read_bytes() == walk.frames[3].image.read_bytes()


def test_nerfstudio_reads_the_rollouts_own_poses_back(exported):
    outputs = parsed(exported, assume_colmap_world_coordinate_convention=False)
    np.testing.assert_allclose(homogeneous(outputs.cameras.camera_to_worlds.numpy()), walk_poses(), atol=1e-5)
    assert outputs.image_filenames[0] == exported / "images" / "frame_00000.png"
    points = outputs.metadata["points3D_xyz"].numpy()
    model = pycolmap.Reconstruction(exported / SPARSE)
    expected = np.array([model.points3D[index].xyz for index in sorted(model.points3D)])
    np.testing.assert_allclose(np.sort(points, axis=0), np.sort(expected, axis=0), atol=1e-4)


def test_nerfstudios_default_turns_poses_by_its_documented_transform(exported):
    outputs = parsed(exported)
    transform = homogeneous(outputs.dataparser_transform.numpy()[None])[0]
    found = homogeneous(outputs.cameras.camera_to_worlds.numpy())
    np.testing.assert_allclose(found, transform @ walk_poses(), atol=1e-5)
    assert not np.allclose(found, walk_poses(), atol=0.1)
    assert outputs.dataparser_scale == 1.0


def test_a_model_without_points_holds_the_poses(walk, tmp_path):
    folder = export_colmap(walk, tmp_path / "bare", points=False, progress=False)
    model = pycolmap.Reconstruction(folder / SPARSE)
    assert (model.num_reg_images(), model.num_points3D()) == (14, 0)
    outputs = parsed(folder, load_3D_points=False)
    assert len(outputs.cameras) == 14


def test_an_existing_folder_is_refused(walk, tmp_path):
    (tmp_path / "model").mkdir()
    with pytest.raises(UsageError, match=r"model: exists already; choose another name"):
        export_colmap(walk, tmp_path / "model", progress=False)
    assert list((tmp_path / "model").iterdir()) == []


def test_a_failure_leaves_nothing_behind(walk, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(colmap, "_write_model", full)
    with pytest.raises(RolloutError, match=r"model: cannot write there: No space left on device"):
        export_colmap(walk, tmp_path / "model", points=False, progress=False)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_walk_through_a_real_room_is_read_back_with_small_errors(shared, tmp_path):
    scene = str(shared / "scenes" / "white_room.glb")
    settings = TaskSettings(budget=30)
    collect(Collect(scene=scene, policy="greedy", out=tmp_path / "r"), settings=settings, heldout=0)
    rollout = read_rollout(tmp_path / "r")
    matches = match_pictures(rollout, progress=False)
    folder = export_colmap(rollout, tmp_path / "model", matches=matches, progress=False)
    model = pycolmap.Reconstruction(folder / SPARSE)
    model.update_point_3d_errors()
    assert model.num_points3D() > 1000
    assert model.compute_mean_reprojection_error() < 1
    reprojection, relative = check_pictures(rollout, matches=matches)
    assert reprojection.passed
    assert relative.passed
    assert relative.figures["rotation_median_deg"] < 0.5
