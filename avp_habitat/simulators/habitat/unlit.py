"""Datasets as Habitat-Sim reads them, shown without any light."""

import ctypes
import json
import os
import tempfile
import threading
from pathlib import Path
from typing import Any

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
