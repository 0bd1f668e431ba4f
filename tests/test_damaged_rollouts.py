"""Rollouts that other programs, full disks or strangers have damaged: a clean error that names the file, or right."""

import functools
import io
import json
import math
import shutil
import struct
import warnings
import zlib

import numpy as np
import pytest
import rerun as rr
from corridor import Corridor
from mlflow import MlflowClient
from PIL import Image
from tracking import mlflow_home

from avp_habitat import seen
from avp_habitat.errors import AVPError, RolloutError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.capture import capture_heldout, capture_step, publish_rollout
from avp_habitat.rollout.format import read_meta, read_rollout
from avp_habitat.rollout.images import read_depth, read_rgb
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.task.env import AVPEnv
from avp_habitat.tracking.rollout_run import rollout_run

ACTIONS = (0, 1, 0)
STRANGE = (
    *(None, True, -1, 0, 2.5, 1e-300, 1e300, math.nan, math.inf, 10**400, 2**70, "", "text", "\ud800", "a\nb", "../.."),
    *([], {}, [[]], {"name": 1}, {"name": {"name": []}}, [1, 2], [math.nan, 0]),
)
KINDS = ("value", "value", "value", "key", "nested", "bytes", "cut", "other file", "stream", "pose", "steps", "gone")
SEEDS = range(240)


def write(folder):
    camera = Intrinsics.from_hfov(16, 12, hfov_deg=90)
    env = AVPEnv(simulator=Corridor(), budget=len(ACTIONS), width=16, height=12)
    env.reset(seed=0)
    with RolloutWriter(folder, camera) as writer:
        info = {}
        for action in ACTIONS:
            _, reward, _, _, info = env.step(action)
            capture_step(env, writer, action, reward, info)
        capture_heldout(env, writer, 2)
        publish_rollout(env, writer, info, policy={"name": "a list"}, seed=0, heldout=2, mlflow_run_id="0" * 32)
    return folder


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return write(tmp_path_factory.mktemp("rollouts") / "whole")


@pytest.fixture
def rollout(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "r0")


def places(value, path=()):
    """The paths of all entries of a JSON value."""
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in entries:
        yield (*path, key)
        yield from places(entry, (*path, key))


def at(value, path):
    for key in path:
        value = value[key]
    return value


def chunk(name, content):
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def with_stream(path, stream, extra=b""):
    """A PNG with other pixels behind its header, all checksums right."""
    path.write_bytes(path.read_bytes()[:33] + extra + chunk(b"IDAT", stream) + chunk(b"IEND", b""))


def pixels(path):
    content, start, stream = path.read_bytes(), 8, b""
    while start < len(content):
        size = int.from_bytes(content[start : start + 4], "big")
        stream += content[start + 8 : start + 8 + size] if content[start + 4 : start + 8] == b"IDAT" else b""
        start += 12 + size
    return stream


def jpeg(size):
    encoded = io.BytesIO()
    Image.new("RGB", size).save(encoded, "JPEG")
    return encoded.getvalue()


def damage(folder, rng):
    """Spoil one thing of a rollout; gives what."""
    kind = KINDS[rng.integers(len(KINDS))]
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    file = files[rng.integers(len(files))]
    picture = [path for path in files if path.suffix == ".png"][rng.integers(4, 10)]
    DAMAGES[kind](folder, file, picture, rng)
    return kind


def _json(folder, rng, change):
    path = folder / "rollout.json"
    meta = json.loads(path.read_text())
    paths = list(places(meta))
    place = paths[rng.integers(len(paths))]
    change(at(meta, place[:-1]), place[-1])
    path.write_text(json.dumps(meta))


def _value(folder, file, picture, rng):
    strange = STRANGE[rng.integers(len(STRANGE))]
    _json(folder, rng, lambda owner, key: owner.__setitem__(key, strange))


def _key(folder, file, picture, rng):
    _json(folder, rng, lambda owner, key: owner.pop(key))


def _nested(folder, file, picture, rng):
    depth = int(rng.choice([5, 20, 50]))
    bottomless = json.loads('{"a":' * depth + "1" + "}" * depth)
    _json(folder, rng, lambda owner, key: owner.__setitem__(key, bottomless))


def _bytes(folder, file, picture, rng):
    content = bytearray(file.read_bytes())
    content[rng.integers(len(content))] ^= 1 << rng.integers(8)
    file.write_bytes(content)


def _cut(folder, file, picture, rng):
    file.write_bytes(file.read_bytes()[: rng.integers(file.stat().st_size)])


def _other_file(folder, file, picture, rng):
    file.write_bytes([b"", b"<!DOCTYPE html><html>", jpeg((16, 12)), b"\x00" * 100][rng.integers(4)])


def _stream(folder, file, picture, rng):
    stream = pixels(picture)
    with_stream(picture, [stream[: len(stream) // 2], b"no stream", zlib.compress(b"\x05" * 9000)][rng.integers(3)])


def _pose(folder, file, picture, rng):
    path = folder / ["poses", "heldout/poses"][rng.integers(2)] / "frame_00000.txt"
    words = path.read_text().split()
    words[rng.integers(16)] = ["nan", "inf", "1e300", "-1e20", "0x10", "", "1_0"][rng.integers(7)]
    path.write_text(" ".join(words))


def _steps(folder, file, picture, rng):
    rows = (folder / "steps.csv").read_text().splitlines()
    row = rng.integers(len(rows))
    cells = rows[row].split(",")
    cells[rng.integers(len(cells))] = ["nan", "", "1e999", "text", '"', "1,2", "\x00", "9" * 400][rng.integers(8)]
    rows[row] = ",".join(cells)
    (folder / "steps.csv").write_text("\n".join(rows))


def _gone(folder, file, picture, rng):
    file.unlink()
    if rng.integers(2):
        file.mkdir()


DAMAGES = {
    "value": _value,
    "key": _key,
    "nested": _nested,
    "bytes": _bytes,
    "cut": _cut,
    "other file": _other_file,
    "stream": _stream,
    "pose": _pose,
    "steps": _steps,
    "gone": _gone,
}


def avp_data(folder):
    from avp_nerfstudio.data.dataparser import AVPDataParserConfig

    parser = AVPDataParserConfig(data=folder).setup()
    for split in ("train", "val"):
        outputs = parser.get_dataparser_outputs(split)
        assert np.isfinite(outputs.cameras.camera_to_worlds.numpy()).all()
        assert np.isfinite(outputs.scene_box.aabb.numpy()).all()
        for image, depth in zip(outputs.image_filenames, outputs.metadata["depth_filenames"], strict=True):
            assert read_rgb(image).shape == (12, 16, 3)
            assert read_depth(depth).shape == (12, 16)


def seen_json(folder):
    report = seen.report_on(folder)
    json.dumps(report, allow_nan=False)
    assert all(0 <= share <= 1 for share in report["per_view"] if share is not None)
    assert all(isinstance(report[name], str) for name in ("scene", "policy"))
    "\t".join(seen.as_row(report)).encode()


def importer(folder):
    from avp_sb3.rerun.rollout import log_rollouts

    recording = rr.RecordingStream("avp")
    log_rollouts(recording, [read_rollout(folder)])
    assert recording.binary_stream().read()


def logged(client, folder):
    found = client.get_run(rollout_run(client, folder)).data
    assert all(math.isfinite(value) for value in found.metrics.values())
    written = {f"eval/{name}": value for name, value in read_meta(folder).get("metrics", {}).items()}
    assert written.items() <= found.metrics.items()


@pytest.fixture
def reader(request, tmp_path, monkeypatch):
    """What reads a rollout; a real MLflow store for the one that needs it."""
    if request.param is not logged:
        return request.param
    return functools.partial(logged, MlflowClient(mlflow_home(tmp_path, monkeypatch)))


@pytest.mark.parametrize(
    "reader", [avp_data, seen_json, importer, logged], ids=lambda reader: reader.__name__, indirect=True
)
def test_of_a_rollout_damaged_at_random_a_reader_names_the_file_or_is_right(whole, tmp_path, reader):
    wrong, refused = [], 0
    seeds = SEEDS[::4] if isinstance(reader, functools.partial) else SEEDS
    for seed in seeds:
        folder = shutil.copytree(whole, tmp_path / str(seed))
        kind = damage(folder, np.random.default_rng(seed))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                reader(folder)
        except AVPError as error:
            refused += 1
            text = str(error)
            if str(folder) not in text or "\n" in text or len(text) > 600 + len(str(folder)):
                wrong.append((seed, kind, text))
        except Exception as error:
            wrong.append((seed, kind, repr(error)))
        shutil.rmtree(folder)
    assert not wrong, "\n".join(map(str, wrong))
    assert len(seeds) / 4 < refused < len(seeds)


HALF, NONE, BOMB = "half a stream", "no stream", "text that expands"


def spoil(path, how):
    """A PNG that nothing but decoding shows to be damaged."""
    stream = pixels(path)
    if how == BOMB:
        with_stream(path, stream, chunk(b"zTXt", b"k\0\0" + zlib.compress(bytes(70 << 20))))
    else:
        with_stream(path, {HALF: stream[: len(stream) // 2], NONE: b"<html></html>"}[how])


@pytest.mark.parametrize("how", [HALF, NONE, BOMB])
@pytest.mark.parametrize(
    ("read", "name"),
    [
        (avp_data, "images/frame_00002.png"),
        (avp_data, "heldout/images/frame_00001.png"),
        (avp_data, "heldout/depth/frame_00000.png"),
        (seen_json, "depth/frame_00001.png"),
        (importer, "images/frame_00000.png"),
        (importer, "trajectory.png"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_a_picture_that_only_decoding_shows_to_be_damaged_is_named(rollout, read, name, how):
    spoil(rollout / name, how)
    with pytest.raises(
        RolloutError,
        match=f"{name}: expected (a readable|an undamaged) PNG, (could not decode it|found one that is not): .",
    ):
        read(rollout)


def test_a_picture_of_a_size_that_only_an_attack_has_is_named(rollout):
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    (rollout / "trajectory.png").write_bytes(bomb)
    with pytest.raises(RolloutError, match=r"trajectory\.png: .* decompression bomb"):
        importer(rollout)


FACTS = {
    "NaN metric": ({"metrics": {"coverage": math.nan}}, "JSON, could not read it: Out of range float"),
    "endless metric": ({"metrics": {"ei": -math.inf}}, "JSON, could not read it: Out of range float"),
    "metric beyond floats": ({"metrics": {"ei": 10**400}}, r"metrics\.ei to be a finite number, found 1000"),
    "metric in words": ({"metrics": {"coverage": "all"}}, r"metrics\.coverage to be a finite number, found 'all'"),
    "metric that is true": ({"metrics": {"coverage": True}}, r"metrics\.coverage to be a finite number, found True"),
    "metrics in a list": ({"metrics": [0.5]}, r"metrics to be an object, found \[0\.5\]"),
    "numbered scene": ({"scene": {"name": 7}}, "name of the scene to be text, found 7"),
    "listed policy": ({"policy": ["greedy"]}, r"name of the policy to be text, found \['greedy'\]"),
    "half a letter": ({"scene": {"name": "\udcff"}}, "JSON, could not read it: .*surrogates"),
    "half a letter in a name": ({"scene": {"\udcff": 1}}, "JSON, could not read it: .*surrogates"),
    "turn in words": ({"actions": {"turn_deg": "ten"}}, r"actions\.turn_deg to be a finite number, found 'ten'"),
    "no whole count": ({"counts": {"frames": 3.0, "heldout": 2}}, r"counts\.frames to be a whole number, found 3\.0"),
}


@pytest.mark.parametrize("fact", FACTS)
@pytest.mark.parametrize("read", [read_meta, read_rollout], ids=["read_meta", "read_rollout"])
def test_every_reader_of_rollout_json_holds_it_to_the_same(rollout, read, fact):
    change, text = FACTS[fact]
    path = rollout / "rollout.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(RolloutError, match=f"rollout.json: expected .*{text}"):
        read(rollout)


def test_a_scene_without_more_than_its_name_is_shown(rollout):
    path = rollout / "rollout.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"scene": "kitchen", "policy": None}))
    assert seen.as_row(seen.report_on(rollout))[1:3] == ["kitchen", ""]


@pytest.mark.parametrize("number", ["1e12", "-1e300", "inf"])
def test_a_pose_beyond_any_room_is_refused(rollout, number):
    path = rollout / "poses/frame_00001.txt"
    words = path.read_text().split()
    words[3] = number
    path.write_text(" ".join(words))
    with pytest.raises(RolloutError, match=r"poses/frame_00001\.txt: expected metres, found "):
        read_rollout(rollout)
