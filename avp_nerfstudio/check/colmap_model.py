"""COLMAP's model of a rollout: its camera and poses as given, points triangulated from matches."""

import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from avp_habitat.poses import Intrinsics, habitat_to_opencv
from avp_nerfstudio.check.pictures_matching import Matches, quiet_colmap


def colmap_camera(intrinsics: Intrinsics) -> pycolmap.Camera:
    """COLMAP's pinhole camera; its pixel centres lie at +0.5, like ours."""
    return pycolmap.Camera(
        model="PINHOLE",
        width=intrinsics.width,
        height=intrinsics.height,
        params=[intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy],
        camera_id=1,
    )


def posed_model(
    names: list[str],
    features: list[NDArray[np.float64]],
    poses: NDArray[np.floating],
    intrinsics: Intrinsics,
) -> pycolmap.Reconstruction:
    """A model without points: image i + 1 is the i-th name.

    Args:
        names: of the n pictures.
        features: per picture `(k, 2)` pixels.
        poses: `(n, 4, 4)` camera_to_world, habitat axes; the model's world is theirs.
        intrinsics: of all pictures.
    """
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(colmap_camera(intrinsics))
    world_to_camera = np.linalg.inv(habitat_to_opencv(poses))
    for index, (name, keypoints) in enumerate(zip(names, features, strict=True)):
        image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world_to_camera[index, :3]))
    return model


def triangulate(
    matches: Matches, poses: NDArray[np.floating], intrinsics: Intrinsics, *, workdir: Path | None = None
) -> pycolmap.Reconstruction:
    """COLMAP's triangulation of the matches, the poses and the camera held fixed.

    COLMAP drops observations that are more than 4 px off; so wrong poses leave few points rather than large errors.

    Args:
        matches: verified ones.
        poses: `(n, 4, 4)` camera_to_world, habitat axes, of the n pictures.
        intrinsics: of all pictures.
        workdir: where the temporary folder is made.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 2
    options.random_seed = 0
    with quiet_colmap(), tempfile.TemporaryDirectory(dir=workdir, prefix="triangulation-") as scratch:
        database = Path(scratch) / "database.db"
        model = posed_model(matches.names, matches.features, poses, intrinsics)
        _write_database(database, matches, model)
        return pycolmap.triangulate_points(model, database, matches.folder, scratch, options=options)


def _write_database(path: Path, matches: Matches, model: pycolmap.Reconstruction) -> None:
    database = pycolmap.Database.open(path)
    try:
        with pycolmap.DatabaseTransaction(database):
            for camera in model.cameras.values():
                database.write_camera(camera, use_camera_id=True)
            for rig in model.rigs.values():
                database.write_rig(rig, use_rig_id=True)
            for frame in model.frames.values():
                database.write_frame(frame, use_frame_id=True)
            for image in model.images.values():
                database.write_image(image, use_image_id=True)
                database.write_keypoints(image.image_id, matches.features[image.image_id - 1].astype(np.float32))
            for pair in matches.pairs:
                geometry = pycolmap.TwoViewGeometry(
                    config=pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED, inlier_matches=pair.features
                )
                database.write_two_view_geometry(pair.first + 1, pair.second + 1, geometry)
    finally:
        database.close()
