"""Rollouts as COLMAP models, and COLMAP's triangulation."""

import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from avp_habitat.errors import RolloutError
from avp_habitat.files import atomic_folder
from avp_habitat.poses import Intrinsics, habitat_to_opencv
from avp_habitat.rollout.format import Rollout
from avp_nerfstudio.check.pictures.matching import Matches, match_pictures, quiet_colmap

IMAGES = "images"
# Where nerfstudio's `colmap` parser looks by default.
SPARSE = Path("colmap") / "sparse" / "0"


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

    Features are `(k, 2)` pixels per picture, poses `(n, 4, 4)` camera_to_world, habitat axes, in the model's world.
    """
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(colmap_camera(intrinsics))
    world_to_camera = np.linalg.inv(habitat_to_opencv(poses))
    for index, (name, keypoints) in enumerate(zip(names, features, strict=True)):
        image = pycolmap.Image(name=name, keypoints=keypoints, camera_id=1, image_id=index + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(world_to_camera[index, :3]))
    return model


def triangulate(matches: Matches, poses: NDArray[np.floating], intrinsics: Intrinsics) -> pycolmap.Reconstruction:
    """COLMAP's triangulation of verified matches, the poses and the camera held fixed.

    COLMAP drops observations that are more than 4 px off; so wrong poses leave few points rather than large errors.
    `(n, 4, 4)` camera_to_world, habitat axes, of the n pictures.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 2
    options.random_seed = 0
    with quiet_colmap(), tempfile.TemporaryDirectory(prefix="triangulation-") as scratch:
        database = Path(scratch) / "database.db"
        model = posed_model(matches.names, matches.features, poses, intrinsics)
        _write_database(database, matches, model)
        return pycolmap.triangulate_points(model, database, matches.folder, scratch, options=options)


def _write_database(path: Path, matches: Matches, model: pycolmap.Reconstruction) -> None:
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
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


def export_colmap(
    rollout: Rollout,
    folder: str | Path,
    *,
    points: bool = True,
    matches: Matches | None = None,
    progress: bool = True,
) -> Path:
    """Write a rollout's frames as a COLMAP model, poses and camera as given, into a new folder.

    It holds `images/` (hard links where the disk allows it, else copies) and `colmap/sparse/0/` (binary), as
    `ns-train nerfacto colmap --data FOLDER` and `pycolmap.Reconstruction(FOLDER/colmap/sparse/0)` read them; image
    i + 1 is frame i, named like the rollout's file. COLMAP prescribes no world axes, so the model keeps the
    rollout's world: metres, Y up; mesh, rollout and model lie in one another. nerfstudio's parser turns it upright by
    its default `--orientation-method up`; with `none` it takes -y for up, so also set
    `--assume-colmap-world-coordinate-convention False` to keep the rollout's world there.

    Args:
        rollout: a checked rollout.
        folder: must not exist; a failure or Ctrl-C leaves nothing behind.
        points: triangulate points from the pictures, with tracks and colours. Without them, nerfstudio's parser needs
            `--load-3D-points False`.
        matches: of the rollout's pictures, where they are known already.
        progress: show bars.

    Raises:
        UsageError: the folder exists.
        RolloutError: a picture cannot be read, or the folder cannot be written.
    """
    with atomic_folder(folder, failure=RolloutError) as partial:
        _write_images(rollout, partial / IMAGES)
        if points and matches is None:
            matches = match_pictures(rollout, progress=progress)
        _write_model(rollout, partial / SPARSE, matches if points else None)
    return Path(folder)


def _write_images(rollout: Rollout, folder: Path) -> None:
    folder.mkdir(parents=True)
    for view in rollout.frames:
        # A link in the rollout would be linked as such: resolve it, so that the export stands on its own.
        source, target = view.image.resolve(), folder / view.image.name
        try:
            os.link(source, target)
        except OSError:
            shutil.copyfile(source, target)


def _write_model(rollout: Rollout, folder: Path, matches: Matches | None) -> None:
    folder.mkdir(parents=True)
    poses = np.array([view.camera_to_world for view in rollout.frames]).reshape(-1, 4, 4)
    if matches is None or not matches.pairs:
        names = [view.image.name for view in rollout.frames]
        model = posed_model(names, [np.empty((0, 2))] * len(names), poses, rollout.intrinsics)
    else:
        model = triangulate(_of_all_frames(matches, rollout), poses, rollout.intrinsics)
    model.write_binary(folder)


def _of_all_frames(matches: Matches, rollout: Rollout) -> Matches:
    """The same matches, among all frames of the rollout: those that were not matched have no features."""
    names, frames = [view.image.name for view in rollout.frames], matches.frames.tolist()
    features = [np.empty((0, 2))] * len(names)
    for frame, found in zip(frames, matches.features, strict=True):
        features[frame] = found
    pairs = [replace(pair, first=frames[pair.first], second=frames[pair.second]) for pair in matches.pairs]
    return Matches(matches.folder, names, np.arange(len(names)), features, pairs)
