"""How a scene is handed to Habitat-Sim: its own dataset config, or one that is written to a temporary folder."""

import ctypes
import json
import os
import tempfile
import threading
from pathlib import Path
from typing import Any

from avp_habitat.scenes.location import Frame, SceneLocation
from avp_habitat.scenes.stage_config import Y_UP

NO_IMAGE = "no-image-based-lighting"
"""In what Habitat-Sim says of the lighting that it was told not to find."""
_CLONE_FS = 0x200


def flat_mediator(habitat: Any, backend: Any, *, lit: bool) -> Any:
    """Habitat-Sim's reader of datasets, told to show objects as it shows stages: flat, since there are no lights.

    Args:
        habitat: the module.
        backend: a `SimulatorConfiguration` that names the dataset.
        lit: whether it may prepare image-based lighting, which costs nothing on a GPU and seconds in software; where
            it may not, it complains of a file `NO_IMAGE`.
    """
    made = None if lit else _unlit_mediator(habitat, backend)
    mediator = made or habitat.metadata.MetadataMediator(backend)
    objects = mediator.object_template_manager
    for handle in objects.get_file_template_handles():
        template = objects.get_template_by_handle(handle)
        template.force_flat_shading = True
        objects.register_template(template, handle)
    return mediator


def _unlit_mediator(habitat: Any, backend: Any) -> Any:
    """Habitat-Sim's reader of datasets, told not to prepare image-based lighting, which flat shading never uses.

    Preparing it takes 6 to 11 s on software rendering; all of the opening takes 0.3 s without. The only way to say so
    is a file `data/default.pbr_config.json` in the current folder when the reader is made, hence a thread with a
    current folder of its own. Where a thread cannot have one, the lighting is prepared.
    """
    made: list[Any] = []

    def make(folder: Path) -> None:
        (folder / "data").mkdir()
        names = {"enable_ibl": False, "ibl_envmap_filename": NO_IMAGE, "ibl_blut_filename": NO_IMAGE}
        (folder / "data" / "default.pbr_config.json").write_text(json.dumps(names), encoding="utf-8")
        if ctypes.CDLL(None).unshare(_CLONE_FS) == 0:
            os.chdir(folder)
            made.append(habitat.metadata.MetadataMediator(backend))

    with tempfile.TemporaryDirectory(prefix="avp-habitat-") as folder:
        thread = threading.Thread(target=make, args=(Path(folder),))
        thread.start()
        thread.join()
    return made[0] if made else None


_NAME = "scene"
_GLTF = (".glb", ".gltf")


def write_stage(location: SceneLocation, frame: Frame, folder: Path) -> tuple[Path, str]:
    """The dataset config and the id in it by which Habitat-Sim opens a scene.

    A bare `.glb` would be read as Z-up, and Habitat-Sim looks beside a bare asset for a NavMesh and semantics that may
    not fit; a stage config of our own says what is meant. Of a `.ply` or `.obj` Habitat-Sim 0.3.4 shows the first mesh
    only, without vertex colours and not turned by the config's axes, so those are written as `.glb` first, and so is a
    scene that is far from its file's origin, because a renderer's float32 has no millimetres there, and a glTF that it
    would show otherwise than it is meant (`avp_habitat.scenes.gltf.shown_as_it_is`). All of it goes to `folder`, never
    beside the user's files. A scene with objects is opened from its own dataset.

    Args:
        location: of the scene.
        frame: how it lies in the world.
        folder: a temporary one.

    Returns:
        Path of the `.scene_dataset_config.json`, and the scene's id.
    """
    if location.objects and location.dataset is not None and location.scene_id is not None:
        return Path(os.path.abspath(location.dataset)), location.scene_id
    if location.asset is not None and not any(frame.origin) and _is_shown_as_it_is(location.asset):
        asset, (up, front) = os.path.abspath(location.asset), (location.up, location.front)
    else:
        asset, (up, front) = _as_glb(location, folder), Y_UP
    stage = {"render_asset": str(asset), "up": list(up), "front": list(front), "force_flat_shading": True}
    (folder / f"{_NAME}.stage_config.json").write_text(json.dumps(stage), encoding="utf-8")
    dataset = folder / "avp.scene_dataset_config.json"
    dataset.write_text(json.dumps({"stages": {"paths": {".json": ["*.stage_config.json"]}}}), encoding="utf-8")
    return dataset, _NAME


def _is_shown_as_it_is(asset: Path) -> bool:
    from avp_habitat.scenes.files import SceneFiles
    from avp_habitat.scenes.gltf import shown_as_it_is

    return asset.suffix.lower() in _GLTF and shown_as_it_is(SceneFiles(asset))


def _as_glb(location: SceneLocation, folder: Path) -> Path:
    from avp_habitat.scenes.export import export_glb
    from avp_habitat.scenes.loader import load_located

    asset = folder / "room.glb"
    export_glb(load_located(location).mesh, asset)
    return asset
