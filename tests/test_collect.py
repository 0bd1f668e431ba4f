import hashlib
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from stable_baselines3 import PPO

from avp_habitat import command
from avp_habitat.collect import main
from avp_habitat.metrics import nearest_neighbour_distance
from avp_habitat.provenance import nerfacto_line
from avp_habitat.rollout import images
from avp_habitat.rollout.format import read_rollout
from avp_habitat.task.env import AVPEnv

SMALL = ["--width", "32", "--height", "24"]


def collect(*words):
    return command.run(main, [str(word) for word in words])


def content(folder):
    """SHA-256 of every file, but for the time and the versions in rollout.json."""
    found = {}
    for path in sorted(folder.rglob("*")):
        data = path.read_bytes() if path.is_file() else b""
        if path.name == "rollout.json":
            meta = json.loads(data)
            assert meta.pop("created")
            assert meta.pop("versions")
            data = json.dumps(meta).encode()
        found[str(path.relative_to(folder))] = hashlib.sha256(data).hexdigest()
    return found


@pytest.fixture(scope="module")
def rollout(tmp_path_factory):
    folder = tmp_path_factory.mktemp("collect") / "r0"
    assert collect("--scene", "builtin:0", "--policy", "heuristic", "--budget", 6, "--out", folder, *SMALL) == 0
    return folder


def test_two_collections_with_one_seed_are_byte_identical(rollout, tmp_path):
    words = ["--scene", "builtin:0", "--policy", "heuristic", "--budget", 6, *SMALL]
    assert collect(*words, "--out", tmp_path / "same") == 0
    assert collect(*words, "--out", tmp_path / "other", "--seed", 1) == 0
    assert content(tmp_path / "same") == content(rollout)
    assert content(tmp_path / "other") != content(rollout)


def test_the_folder_holds_what_the_design_says(rollout):
    found = read_rollout(rollout)
    assert (len(found.frames), len(found.heldout)) == (6, 20)
    names = {path.name for path in rollout.iterdir()}
    assert names == {
        "rollout.json", "transforms.json", "images", "depth", "poses", "steps.csv", "heldout", "trajectory.png",
        "floor.png",
    }  # fmt: skip
    meta = found.meta
    assert meta["scene"]["name"] == "builtin:0"
    assert meta["policy"]["name"] == "heuristic"
    assert (meta["budget"], meta["seed"], meta["reward"]) == (6, 0, "proposed")
    assert meta["coverage"]["navigable_cells"] * 0.01 == pytest.approx(meta["coverage"]["navigable_area_m2"], rel=0.05)
    rows = (rollout / "steps.csv").read_text().splitlines()
    assert len(rows) == 7
    assert rows[0].startswith("step,action,reward,reward_coverage,")


def test_the_figures_in_the_file_are_those_of_the_poses(rollout):
    found = read_rollout(rollout)
    positions = np.array([view.camera_to_world[:3, 3] for view in found.frames])
    metrics = found.meta["metrics"]
    assert metrics["annd_m"] == pytest.approx(nearest_neighbour_distance(positions), abs=1e-6)
    assert metrics["ei"] == pytest.approx(metrics["coverage"] / 6)
    rows = np.genfromtxt(rollout / "steps.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert rows["coverage"][-1] == pytest.approx(metrics["coverage"])
    parts = [name for name in rows.dtype.names if name.startswith("reward_")]
    np.testing.assert_allclose(sum(rows[name] for name in parts), rows["reward"], atol=1e-6)
    np.testing.assert_allclose(positions[:, [0, 2]], np.stack([rows["x_m"], rows["z_m"]], axis=1), atol=1e-5)
    np.testing.assert_allclose(positions[:, 1], rows["y_m"] + 1.5, atol=1e-5)


def test_pictures_and_depth_come_from_the_written_pose(rollout):
    found = read_rollout(rollout)
    env = AVPEnv("builtin:0")
    for view in (found.frames[3], found.heldout[7]):
        frames = env.capture(view.camera_to_world[None], found.intrinsics)
        difference = images.read_rgb(view.image).astype(int) - frames.rgb[0]
        assert np.abs(difference).mean() < 0.5
        assert np.median(np.abs(images.read_depth(view.depth) - frames.depth[0])) < 0.001


def test_heldout_views_belong_to_the_scene_and_not_to_the_episode(rollout, tmp_path):
    assert collect("--scene", "builtin:0", "--policy", "random", "--seed", 9, "--budget", 3, "--out", tmp_path / "r",
                   *SMALL) == 0  # fmt: skip
    ours, theirs = read_rollout(rollout), read_rollout(tmp_path / "r")
    for one, other in zip(ours.heldout, theirs.heldout, strict=True):
        np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)
    for heldout in ours.heldout:
        for frame in ours.frames:
            assert not np.allclose(heldout.camera_to_world, frame.camera_to_world, atol=1e-3)


def test_it_prints_the_figures_and_what_to_run_next(tmp_path, capfd):
    collect("--scene", "builtin:0", "--policy", "random", "--budget", 3, "--out", tmp_path / "r", *SMALL)
    printed = capfd.readouterr().out
    assert "3 views, coverage" in printed
    assert "annd_m" in printed
    assert printed.startswith("opening builtin:0 for random …\n")
    assert nerfacto_line(str(tmp_path / "r")) in printed


def test_a_trained_model_collects_and_its_run_is_named(tmp_path):
    model = PPO("MlpPolicy", AVPEnv("builtin:0", width=8, height=8), n_steps=8, batch_size=8)
    model.avp_mlflow_run_id = "f00d"
    model.save(tmp_path / "model.zip")
    words = ["--scene", "builtin:0", "--policy", tmp_path / "model.zip", "--budget", 4, *SMALL]
    assert collect(*words, "--out", tmp_path / "a") == 0
    assert collect(*words, "--out", tmp_path / "b", "--stochastic") == 0
    assert collect(*words, "--out", tmp_path / "c", "--stochastic") == 0
    meta = read_rollout(tmp_path / "a").meta
    assert meta["policy"]["name"] == "model.zip"
    assert meta["mlflow_run_id"] == "f00d"
    assert content(tmp_path / "b") == content(tmp_path / "c")


def foreign_model(folder):
    import gymnasium

    path = folder / "cartpole.zip"
    PPO("MlpPolicy", gymnasium.make("CartPole-v1"), n_steps=8, batch_size=8).save(path)
    return path


def test_a_model_of_another_environment_is_refused(tmp_path, capfd):
    model = foreign_model(tmp_path)
    code = collect("--scene", "builtin:0", "--policy", model, "--out", tmp_path / "r", *SMALL)
    error = capfd.readouterr().err
    assert code == 1
    assert "cartpole.zip: trained for the observation_space" in error
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"--policy": "heuristc"}, 2, "unknown policy 'heuristc': .*did you mean 'heuristic'"),
        ({"--policy": "missing.zip"}, 2, "missing.zip: no such model file"),
        ({"--reward": "propose"}, 2, "unknown reward 'propose': .*did you mean 'proposed'"),
        ({"--simulator": "habitt"}, 2, "unknown simulator 'habitt': .*did you mean 'habitat'"),
        ({"--scene": "builtin:first"}, 2, "builtin:first: expected builtin:SEED"),
        ({"--scene": "nowhere.glb"}, 1, "nowhere.glb: no such scene file"),
        ({"--scene": "room.xyz"}, 2, "room.xyz: expected a scene file"),
        ({"--budget": "0"}, 2, "budget: expected a whole number from 1 to 32,767, got 0"),
        ({"--width": "4"}, 2, "--width: expected a whole number from 8 to 8,192, got 4"),
        ({"--seed": "-1"}, 2, "--seed: expected a whole number from 0 to 4,294,967,295, got -1"),
    ],
)
def test_wrong_input_is_one_line_with_its_exit_code(tmp_path, capfd, change, code, words):
    options = {"--scene": "builtin:0", "--policy": "random", "--out": tmp_path / "r"} | change
    assert collect(*SMALL, *[word for pair in options.items() for word in pair]) == code
    error = capfd.readouterr().err.strip().splitlines()[-1]
    assert re.search(words, error), error
    assert error.startswith("error: ")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_not_touched(rollout, capfd):
    before = content(rollout)
    assert collect("--scene", "builtin:0", "--policy", "random", "--out", rollout) == 2
    assert "exists already" in capfd.readouterr().err
    assert content(rollout) == before


def test_a_damaged_model_file_is_named(tmp_path, capfd):
    (tmp_path / "model.zip").write_bytes(b"PK but no zip")
    assert collect("--scene", "builtin:0", "--policy", tmp_path / "model.zip", "--out", tmp_path / "r") == 1
    assert "model.zip: expected a model of Stable-Baselines3" in capfd.readouterr().err


@pytest.mark.parametrize("name", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_an_interrupted_collection_leaves_no_folder(tmp_path, name):
    line = [sys.executable, "-m", "avp_habitat.collect", "--scene", "builtin:0", "--policy", "random"]
    process = subprocess.Popen([*line, "--out", str(tmp_path / "r")], stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    deadline = time.monotonic() + 120
    while not list(tmp_path.glob(".r.partial-*/images/*.png")) and time.monotonic() < deadline:
        time.sleep(0.05)
    os.kill(process.pid, name)
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "interrupted" in error.splitlines()[-1]
    assert "Traceback" not in error
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(importlib.util.find_spec("habitat_sim") is not None, reason="habitat-sim is installed here")
def test_without_habitat_sim_the_error_says_how_to_get_it(tmp_path, capfd):
    code = collect("--scene", "builtin:0", "--policy", "random", "--simulator", "habitat", "--out", tmp_path / "r")
    assert code == 1
    assert "habitat-sim is not installed, and the package index has none; build version 0.3.4" in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_real_room_has_the_navigable_area_of_habitats_navmesh(shared):
    # Habitat-Sim's own NavMesh gives 27.4 and 14.4 m² for these rooms.
    for name, area in (("white_room", 27.4), ("grey_white_room", 14.4)):
        assert AVPEnv(str(shared / "scenes" / f"{name}.glb")).area.area_m2 == pytest.approx(area, rel=0.05)
