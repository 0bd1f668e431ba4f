"""Folders of other tools, made here as those tools lay them out, given to `avp-data` and to the checks of poses."""

import json
import re
import shlex
import struct
import typing
from pathlib import Path

import numpy as np
import pytest
from nerfstudio_room import write_room
from PIL import Image

from avp_habitat.errors import RolloutError

pytest.importorskip("nerfstudio")

import nerfstudio.scripts.train  # noqa: F401
import tyro
from nerfstudio.configs.dataparser_configs import dataparsers

from avp_habitat import command
from avp_nerfstudio.check.__main__ import Check
from avp_nerfstudio.data.dataparser import AVPDataParserConfig


def frame(index, **more):
    pose = np.eye(4)
    pose[0, 3] = index
    return {"file_path": f"images/{index}.png", "transform_matrix": pose.tolist()} | more


CAMERA = {"fl_x": 8.0, "fl_y": 8.0, "cx": 4.0, "cy": 3.0, "w": 8, "h": 6}
COLMAP_CAMERA = struct.pack("<QiiQQ4d", 1, 1, 1, 8, 6, 8, 8, 4, 3)
COLMAP_IMAGES = struct.pack("<Q", 2) + b"".join(
    struct.pack("<i7di", 1 + index, 1, 0, 0, 0, index, 0, 0, 1) + f"{index}.png".encode() + b"\0" + struct.pack("<Q", 0)
    for index in range(2)
)


def put(folder, name, content=b""):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, dict):
        path.write_text(json.dumps(content))
    elif name.endswith((".png", ".jpg")):
        Image.new("RGB", (8, 6)).save(path)
    else:
        path.write_bytes(content)


def colmap(folder, model):
    put(folder, f"{model}/cameras.bin", COLMAP_CAMERA)
    put(folder, f"{model}/images.bin", COLMAP_IMAGES)
    put(folder, f"{model}/points3D.bin", struct.pack("<QQ3d3BdQ", 1, 1, 0, 0, 2, 9, 9, 9, 0.5, 0))
    put(folder, "images/0.png")
    put(folder, "images/1.png")


def files(*names):
    return lambda folder: [put(folder, name) for name in names]


def transforms(name="transforms.json", **content):
    def make(folder):
        put(folder, "images/0.png")
        put(folder, "images/1.png")
        for split in ("train", "val", "test") if "train" in name else ("",):
            put(folder, name.replace("train", split), content)

    return make


SYNTHETIC = [frame(index, file_path=f"./images/{index}") for index in range(2)]
SHOTS = [frame(0), frame(1)]
FOLDERS = {
    "COLMAP in sparse/0": (lambda f: colmap(f, "sparse/0"), "a COLMAP project", "colmap .*--colmap-path sparse/0"),
    "COLMAP in sparse": (lambda f: colmap(f, "sparse"), "a COLMAP project", "colmap .*--colmap-path sparse"),
    "COLMAP of nerfstudio": (
        lambda f: colmap(f, "colmap/sparse/0"),
        "a COLMAP project",
        "colmap .*--colmap-path colmap/",
    ),
    "nerfstudio": (transforms(camera_model="OPENCV", frames=SHOTS, **CAMERA), "data of nerfstudio", "nerfstudio-data"),
    "NeRF synthetic": (
        transforms("transforms_train.json", camera_angle_x=0.7, frames=SYNTHETIC),
        "a synthetic scene of NeRF",
        "blender-data",
    ),
    "Polycam": (files("keyframes/images/1.jpg", "raw.glb"), "a capture of Polycam", "polycam"),
    "Record3D": (files("rgb/0.jpg", "metadata.json"), "a capture of Record3D", "record3d"),
    "ScanNet": (
        files("color/0.jpg", "depth/0.png", "pose/0.txt", "intrinsic/intrinsic_color.txt"),
        "a scene of ScanNet",
        "scannet-data",
    ),
    "ScanNet++": (files("dslr/nerfstudio/transforms.json"), r"a scene of ScanNet\+\+", "scannetpp-data"),
    "ARKitScenes": (files("1_frames/lowres_wide/0.png"), "a scene of ARKitScenes", "arkit-data"),
    "SDFStudio": (files("meta_data.json", "0_rgb.png"), "a scene of SDFStudio", "sdfstudio-data"),
    "pictures": (files("DSC_1.jpg", "DSC_2.jpg"), "pictures without poses", "ns-process-data images"),
    "rollouts": (lambda f: write_room(f / "r0", frames=1, heldout=1), "a folder of rollouts", "name one of them"),
    "a training": (files("config.yml", "nerfstudio_models/a.ckpt"), "a training of nerfstudio", "what --data takes"),
}


def refusal(path):
    with pytest.raises(RolloutError, match="expected a rollout") as caught:
        AVPDataParserConfig(data=path).setup().get_dataparser_outputs()
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text
    return text


@pytest.mark.parametrize("kind", FOLDERS)
def test_a_folder_of_another_tool_is_recognised_and_its_reader_named(tmp_path, kind):
    make, what, reader = FOLDERS[kind]
    folder = tmp_path / "their data"
    folder.mkdir()
    make(folder)
    text = refusal(folder)
    assert re.search(f"expected a rollout \\(rollout.json\\), found what looks like {what}.*{reader}", text)
    with pytest.raises(RolloutError, match=what):
        command.parse(Check, [str(folder), "--no-pictures"])
    assert [path.name for path in tmp_path.iterdir()] == ["their data"]


@pytest.mark.parametrize(
    "kind", ["COLMAP in sparse/0", "COLMAP in sparse", "COLMAP of nerfstudio", "nerfstudio", "NeRF synthetic"]
)
def test_the_parser_that_is_named_reads_the_folder(tmp_path, kind):
    FOLDERS[kind][0](tmp_path)
    command = shlex.split(re.search("try `(.*)`", refusal(tmp_path))[1])
    assert command[:2] == ["ns-train", "nerfacto"]
    parser = tyro.cli(type(dataparsers[command[2]]), args=command[3:]).setup()
    split = parser.get_dataparser_outputs("train")
    assert {path.name for path in split.image_filenames} & {"0.png", "1.png"}


def test_every_parser_and_converter_that_is_named_exists():
    from nerfstudio.scripts.process_data import Commands

    from avp_nerfstudio.data import refusals

    text = " ".join(how for _, _, how in refusals._KINDS)
    assert set(re.findall(r"parser ([\w-]+) ?", text)) <= set(dataparsers)
    converters = {note.name for kind in typing.get_args(Commands) for note in getattr(kind, "__metadata__", ())}
    assert set(re.findall(r"converter (\w+)", text)) | {"images", "video"} <= converters


@pytest.mark.parametrize(
    ("name", "what"),
    [("room.glb", "a scene's mesh: take pictures in it first"), ("a.mp4", "a video"), ("a.MOV", "a video")],
)
def test_a_file_of_another_tool_is_recognised(tmp_path, name, what):
    put(tmp_path, name)
    assert what in refusal(tmp_path / name)


def test_a_rollout_that_lost_its_description_is_still_one(tmp_path):
    room = write_room(tmp_path / "room", frames=1, heldout=1)
    (room / "rollout.json").unlink()
    with pytest.raises(RolloutError, match=r"rollout\.json: expected this file of the rollout, found none"):
        AVPDataParserConfig(data=room).setup().get_dataparser_outputs()


def test_what_is_nothing_known_is_told_what_was_expected(tmp_path):
    put(tmp_path, "notes.txt")
    with pytest.raises(RolloutError, match=r"rollout\.json: expected this file of the rollout, found none"):
        AVPDataParserConfig(data=tmp_path).setup().get_dataparser_outputs()


def test_a_relative_path_that_leads_nowhere_says_what_it_is_relative_to(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        RolloutError, match=f"^r0: expected a rollout folder .*; the path is relative to .* now {tmp_path}$"
    ):
        AVPDataParserConfig(data=Path("r0")).setup().get_dataparser_outputs()
