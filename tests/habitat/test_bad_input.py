"""What a user can get wrong with `--simulator habitat`: one line with what to do, and nothing is left behind."""

import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from shapes import furnished, small_dataset, wall, write_json, write_room

from avp_habitat import collect, command

pytestmark = pytest.mark.habitat


@pytest.fixture(scope="module")
def inputs(tmp_path_factory) -> Path:
    """Scenes, data sets and NavMesh files, good and bad."""
    folder = tmp_path_factory.mktemp("inputs")
    room = write_room(folder / "room.glb", furnished())
    write_room(folder / "wall.glb", wall())
    write_room(folder / "low.glb", [([np.multiply(c, 0.01) for c in corners], rgb) for corners, rgb in furnished()])
    (folder / "cut.glb").write_bytes(room.read_bytes()[:1500])
    (folder / "noise.glb").write_bytes(np.random.default_rng(0).bytes(4000))
    (folder / "empty.glb").touch()
    (folder / "cut.ply").write_text("ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nend_header\n1\n")
    small_dataset(folder / "data")
    write_json(folder / "gone.stage_config.json", {"render_asset": "nowhere.glb"})
    (folder / "empty.navmesh").touch()
    (folder / "noise.navmesh").write_bytes(np.random.default_rng(0).bytes(4000))
    (folder / "folder.navmesh").mkdir()
    return folder


def only_ours(stderr: str) -> list[str]:
    """Lines without those that a static build of Habitat-Sim prints when it is imported."""
    return [line for line in stderr.splitlines() if not line.startswith("PluginManager::Manager: duplicate static")]


DATASET = "data/small.scene_dataset_config.json"
# Options, exit code, error.
MISTAKES = [
    ("--scene rom.glb", 1, r"rom\.glb: no such scene file; did you mean 'room\.glb'\?"),
    ("--scene no/where/room.glb", 1, r"no/where/room\.glb: there is no folder no/where"),
    ("--scene room", 2, r"room: expected a scene file, got the suffix ''; a scene is a mesh \(\.glb .*\), .*"),
    ("--scene builtin:x", 2, r"builtin:x: expected builtin:SEED with an integer SEED >= 0, got 'x'"),
    ("--scene data", 1, r"data: expected a scene file, found a folder that is no scene of Replica"),
    ("--scene wall.glb", 1, r"wall\.glb: Habitat-Sim found no floor for its NavMesh; is the scene Y-up, in metres\?"),
    ("--scene low.glb", 1, r"low\.glb: Habitat-Sim found no floor for its NavMesh; is the scene Y-up, in metres\?"),
    ("--scene cut.glb", 1, r"cut\.glb: .*"),
    ("--scene noise.glb", 1, r"noise\.glb: .*"),
    ("--scene empty.glb", 1, r"empty\.glb: the file is empty"),
    ("--scene cut.ply", 1, r"cut\.ply: .*"),
    ("--scene gone.stage_config.json", 1, r"gone\.stage_config\.json: render_asset: there is no file nowhere\.glb"),
    (f"--scene {DATASET}", 2, r".*: expected small\.scene_dataset_config\.json:ID with the id of a scene; it has 3 .*"),
    (
        f"--scene {DATASET}:withs",
        1,
        r".*: has no scene 'withs'; it has 3 scenes, such as room, with, .*; did you mean 'with\b.*'\?",
    ),
    (
        "--scene room.glb --gpu 99",
        1,
        r"habitat: there is no CUDA device 99: EGL offers .*; use --gpu -1 for software .*",
    ),
    ("--scene room.glb --gpu -2", 2, r"--gpu: expected a CUDA device from 0, or -1 for none, got -2"),
    (
        "--scene room.glb --navmesh nose.navmesh",
        1,
        r"nose\.navmesh: no such NavMesh file .*; did you mean 'noise\.navmesh'\?",
    ),
    (
        "--scene room.glb --navmesh folder.navmesh",
        1,
        r"folder\.navmesh: no such NavMesh file \(\.navmesh\).*",
    ),
    (
        "--scene room.glb --navmesh empty.navmesh",
        1,
        r"empty\.navmesh: expected a NavMesh .*, but it ends after 0 bytes.*",
    ),
    (
        "--scene room.glb --navmesh noise.navmesh",
        1,
        r"noise\.navmesh: expected a NavMesh .*, but it does not begin as one.*",
    ),
    (
        "--scene room.glb --navmesh room.glb",
        1,
        r"room\.glb: expected a NavMesh .*, but it does not begin as one.*",
    ),
    (
        "--scene room.glb --simulator raycast --navmesh noise.navmesh",
        1,
        r"noise\.navmesh: expected a NavMesh .*, but it does not begin as one.*",
    ),
    ("--scene room.glb --simulator raycast --gpu 0", 2, r"--gpu: is of the simulator 'habitat', but 'raycast' was .*"),
    ("--scene room.glb --simulator habitt", 2, r"unknown simulator 'habitt': .*; did you mean 'habitat'\?"),
]


@pytest.mark.parametrize(("options", "code", "message"), MISTAKES, ids=[mistake[0] for mistake in MISTAKES])
def test_a_mistake_is_one_line_and_leaves_nothing(inputs, monkeypatch, tmp_path, capfd, options, code, message):
    monkeypatch.chdir(inputs)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    before = sorted(inputs.rglob("*"))
    arguments = ["--simulator", "habitat", "--policy", "random", "--budget", "2", "--out", "out", *options.split()]
    assert command.run(collect.main, arguments) == code
    said, complained = capfd.readouterr()
    assert re.fullmatch("(opening .* for random …\n)?", said)
    (line,) = only_ours(complained)
    assert re.fullmatch(f"error: {message}", line), line
    assert sorted(inputs.rglob("*")) == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", ["--scene wall.glb", "--scene room.glb --navmesh noise.navmesh"])
def test_a_mistake_ends_the_process_with_one_line(inputs, tmp_path, options):
    out = tmp_path / "out"
    done = subprocess.run(
        [sys.executable, "-m", "avp_habitat.collect", "--simulator", "habitat", "--policy", "random", "--out", str(out)]
        + options.split(),
        cwd=inputs,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 1
    assert re.fullmatch("opening .* for random …\n", done.stdout)
    (line,) = only_ours(done.stderr)
    assert line.startswith("error: ")
    assert list(tmp_path.iterdir()) == []


def test_after_a_mistake_the_same_process_opens_a_scene(inputs, opened, monkeypatch):
    from avp_habitat.errors import SceneError

    monkeypatch.chdir(inputs)
    for _ in range(3):
        with pytest.raises(SceneError, match="found no floor"):
            opened("wall.glb")
    assert opened("room.glb").area.area_m2 > 10
