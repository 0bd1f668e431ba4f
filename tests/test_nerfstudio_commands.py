"""Real `ns-` commands; each spends tens of seconds importing nerfstudio on a small machine."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from nerfstudio_room import write_room

pytest.importorskip("nerfstudio")

PLAIN = [
    "nerfacto",
    "--machine.device-type",
    "cpu",
    "--pipeline.model.implementation",
    "torch",
    "--mixed-precision",
    "False",
    "--pipeline.model.log2-hashmap-size",
    "8",
    "--vis",
    "tensorboard",
]


def command(name, *arguments, folder, environment=None):
    return subprocess.run(
        [Path(sys.executable).parent / name, *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "COLUMNS": "300", **(environment or {})},
        capture_output=True,
        text=True,
        timeout=500,
    )


def train(folder, method, *data, environment=None):
    out = ["--output-dir", folder, "--experiment-name", "e", "--timestamp", "t"]
    batch = ["--max-num-iterations", 3, "--pipeline.datamanager.train-num-rays-per-batch", 64]
    done = command("ns-train", *method, *out, *batch, *data, folder=folder, environment=environment)
    return done, folder / "e" / method[0] / "t" / "config.yml"


def evaluate(folder, config, environment=None):
    done = command(
        "ns-eval", "--load-config", config, "--output-path", folder / "s.json", folder=folder, environment=environment
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done, json.loads((folder / "s.json").read_text())["results"]


def test_avp_nerfacto_trains_and_is_scored_without_network(tmp_path):
    room = write_room(tmp_path / "room")
    offline = {"TORCH_HOME": str(tmp_path / "empty"), "https_proxy": "http://127.0.0.1:9"}
    done, config = train(tmp_path, ["avp-nerfacto"], "--data", room, environment=offline)
    assert done.returncode == 0, done.stdout + done.stderr
    done, results = evaluate(tmp_path, config, offline)
    assert 3 < results["psnr"] < 60
    assert "lpips" not in results
    assert done.stdout.count("LPIPS is not computed") == 1


@pytest.mark.slow
def test_plain_nerfacto_trains_on_avp_data_and_its_checkpoint_opens_with_the_safe_loader(tmp_path, shared):
    room = write_room(tmp_path / "room", width=80, height=64)
    weights = {"TORCH_HOME": str(shared / "torch_home")}
    done, config = train(tmp_path, PLAIN, "avp-data", "--data", room, environment=weights)
    assert done.returncode == 0, done.stdout + done.stderr
    _, results = evaluate(tmp_path, config, weights)
    assert {"psnr", "ssim", "lpips"} <= set(results)


@pytest.mark.slow
def test_a_damaged_rollout_ends_ns_train_with_one_line(tmp_path):
    room = write_room(tmp_path / "room", frames=2, heldout=1)
    (room / "images/frame_00001.png").unlink()
    done, _ = train(tmp_path, ["avp-nerfacto"], "--data", room)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.splitlines()[-1].startswith(f"error: {room}/images/frame_00001.png: expected this file")
