"""How a scene of the Replica data set lies on disk, so that it can be recognised.

As its repository describes it (github.com/facebookresearch/Replica-Dataset, README.md):

    replica.scene_dataset_config.json           room_0/habitat/mesh_semantic.ply    quads with an object_id per face
    room_0/mesh.ply   quads, vertex colours     room_0/habitat/info_semantic.json
    room_0/textures/  (PTex, not shown here)    room_0/habitat/replica_stage.stage_config.json

Both meshes are Z-up (github.com/facebookresearch/habitat-sim, issue 2631). The stage config says nothing of that: its
keys are render_asset (`../mesh.ply`), semantic_asset, semantic_descriptor_filename and nav_asset (as quoted in
github.com/facebookresearch/sound-spaces, issue 143); the axes stand in the dataset config's defaults for stages.
"""

import os
from pathlib import Path

MESH = "mesh.ply"
SEMANTIC_MESH = "mesh_semantic.ply"
STAGE = "replica_stage.stage_config.json"
_HABITAT = "habitat"
_SIGNS = (SEMANTIC_MESH, "info_semantic.json", STAGE)


def scene_folder(path: Path) -> Path | None:
    """The folder of the scene that a mesh or stage config of Replica belongs to, None for any other file.

    Args:
        path: `room_0/mesh.ply`, `room_0/habitat/mesh_semantic.ply` or the stage config beside it.
    """
    absolute = Path(os.path.abspath(path))
    if path.name == MESH:
        return absolute.parent if is_scene(absolute.parent) else None
    if path.name in (SEMANTIC_MESH, STAGE) and absolute.parent.name == _HABITAT:
        return absolute.parents[1] if is_scene(absolute.parents[1]) else None
    return None


def is_scene(folder: Path) -> bool:
    """Whether a folder has `habitat/` with at least two of Replica's files in it, or one of them and `mesh.ply`."""
    signs = [folder / _HABITAT / name for name in _SIGNS]
    count = sum(path.is_file() for path in signs)
    return count > 0 and count + (folder / MESH).is_file() > 1


def scenes_within(folder: Path) -> list[str]:
    """Names of the scenes in a folder that holds the data set, sorted."""
    return sorted(entry.name for entry in folder.iterdir() if entry.is_dir() and is_scene(entry))
