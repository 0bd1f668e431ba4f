"""Real `ns-` commands on checkpoints trained for a second, with the safe loader on."""

import gzip
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio_room import ROOM, picture, random_poses, write_room
from nerfstudio_shell import Shell

from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.rollout.writing import RolloutWriter

pytest.importorskip("nerfstudio")

import imageio_ffmpeg
from PIL import Image

from avp_nerfstudio.camera_path import CameraPath, camera_path
from avp_nerfstudio.method.checkpoints import allow_checkpoints

WIDTH, HEIGHT, FRAMES, HELDOUT, ITERATIONS = 48, 36, 8, 2, 200
SMALL = ["--pipeline.datamanager.train-num-rays-per-batch", 128, "--pipeline.model.log2-hashmap-size", 10]
PLAIN = [
    "nerfacto",
    "--machine.device-type",
    "cpu",
    "--pipeline.model.implementation",
    "torch",
    "--mixed-precision",
    "False",
    "--vis",
    "tensorboard",
]


class RunsCode:
    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def write_walk(folder):
    """A walk through the room with a camera that nerfstudio's camera paths can have: the axis in the middle."""
    intrinsics = Intrinsics.from_hfov(WIDTH, HEIGHT, hfov_deg=90.0)
    steps = np.arange(FRAMES)
    positions = np.column_stack([-0.8 + 0.25 * steps, np.full(FRAMES, 1.5), -1.0 + 0.1 * steps])
    with RolloutWriter(folder, intrinsics) as writer:
        for pose in camera_to_world(positions, yaw=0.3 * steps, pitch=0.1 * steps - 0.3):
            writer.add_frame(*picture(pose, intrinsics), pose)
        for pose in random_poses(HELDOUT, seed=2):
            writer.add_heldout(*picture(pose, intrinsics), pose)
        writer.publish({"scene": "a formula"})
    return folder


def train(run, folder, method, *data, timestamp="t", iterations=ITERATIONS, environment=None):
    """`run` takes a command's words; the run's config.yml."""
    out = ["--output-dir", folder, "--experiment-name", "e", "--timestamp", timestamp]
    words = [*method, *out, "--max-num-iterations", iterations, *SMALL, *data]
    succeeded(run("ns-train", *words, environment=environment))
    return folder / "e" / method[0] / timestamp / "config.yml"


def succeeded(done):
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def only_line(done):
    """The last words of a command that failed without a traceback."""
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    return done.stderr.splitlines()[-1]


def checkpoint(config):
    allow_checkpoints()
    (path,) = (config.parent / "nerfstudio_models").iterdir()
    return path, torch.load(path)


def copy_with(config, folder, **extra):
    """A run with other things in its checkpoint, and its config.yml."""
    shutil.copytree(config.parent, folder / "e" / config.parent.parent.name / "t")
    copy = folder / "e" / config.parent.parent.name / "t" / "config.yml"
    # The config remembers its output folder as the words of its path.
    old, new = ("\n".join(f"- {part}" for part in path.parts[1:]) for path in (config.parents[3], folder))
    text = copy.read_text()
    assert old in text
    copy.write_text(text.replace(old, new))
    path, content = checkpoint(copy)
    torch.save({**content, **extra}, path)
    return copy


def pixels(path):
    return np.asarray(Image.open(path)).astype(int)


def points_and_normals(path):
    import open3d

    cloud = open3d.io.read_point_cloud(str(path))
    return np.asarray(cloud.points), np.asarray(cloud.normals)


def triangles(path):
    import open3d

    return len(open3d.io.read_triangle_mesh(str(path)).triangles)


@pytest.fixture(scope="module")
def shell():
    with Shell() as shell:
        yield shell


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    return write_walk(tmp_path_factory.mktemp("rollouts") / "walk")


@pytest.fixture(scope="module")
def offline(tmp_path_factory):
    return {"TORCH_HOME": str(tmp_path_factory.mktemp("empty")), "https_proxy": "http://127.0.0.1:9"}


@pytest.fixture(scope="module")
def trained(shell, walk, offline, tmp_path_factory):
    """The config.yml of avp-nerfacto trained on the walk."""
    folder = tmp_path_factory.mktemp("outputs")
    return train(shell.run, folder, ["avp-nerfacto"], "--data", walk, environment=offline)


def test_avp_nerfacto_trains_and_is_scored_without_network(shell, trained, offline, tmp_path):
    scores = tmp_path / "s.json"
    done = succeeded(shell.run("ns-eval", "--load-config", trained, "--output-path", scores, environment=offline))
    results = json.loads(scores.read_text())["results"]
    assert 3 < results["psnr"] < 60
    assert "lpips" not in results
    assert done.stdout.count("LPIPS is not computed") == 1


def test_ns_render_writes_the_heldout_views_with_depth_in_metres(shell, trained, tmp_path):
    names = ["--rendered-output-names", "rgb", "depth", "raw-depth"]
    succeeded(shell.run("ns-render", "dataset", "--load-config", trained, "--output-path", tmp_path, *names))
    for kind in ("rgb", "depth"):
        shapes = [pixels(path).shape for path in sorted((tmp_path / "test" / kind).iterdir())]
        assert shapes == [(HEIGHT, WIDTH, 3)] * HELDOUT
    for path in (tmp_path / "test/raw-depth").iterdir():
        with gzip.open(path) as file:
            depth = np.load(file)
        assert depth.shape == (HEIGHT, WIDTH, 1)
        assert 0 < depth.min() <= depth.max() < np.linalg.norm(ROOM[1] - ROOM[0]) + 0.5


def test_a_camera_path_begins_and_ends_with_what_the_first_and_last_frame_see(shell, trained, walk, tmp_path):
    path = tmp_path / "path.json"
    path.write_text(json.dumps(camera_path(CameraPath(walk, path, seconds=1, fps=5, width=WIDTH, height=HEIGHT))))
    load = ["--load-config", trained, "--image-format", "png"]
    film = ["--camera-path-filename", path, "--output-path", tmp_path / "film", "--output-format", "images"]
    succeeded(shell.run("ns-render", "camera-path", *load, *film))
    seen = ["--split", "train", "--rendered-output-names", "rgb", "--output-path", tmp_path]
    succeeded(shell.run("ns-render", "dataset", *load, *seen))
    shots = [pixels(shot) for shot in sorted((tmp_path / "film").iterdir())]
    first, last = (pixels(tmp_path / f"train/rgb/frame_{index:05d}.png") for index in (0, FRAMES - 1))
    assert len(shots) == 5
    assert np.abs(shots[0] - first).max() <= 2
    assert np.abs(shots[-1] - last).max() <= 2
    assert np.abs(first - last).mean() > 5


def test_ns_render_makes_a_video_where_no_ffmpeg_is_installed(shell, trained, walk, tmp_path):
    path = tmp_path / "path.json"
    path.write_text(json.dumps(camera_path(CameraPath(walk, path, seconds=0.5, fps=12, width=WIDTH, height=HEIGHT))))
    words = ["--load-config", trained, "--camera-path-filename", path, "--rendered-output-names", "rgb", "depth"]
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    bare = {"PATH": str(tmp_path), "TMPDIR": str(temporary)}
    succeeded(shell.run("ns-render", "camera-path", *words, "--output-path", tmp_path / "a.mp4", environment=bare))
    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a.mp4"))
    properties, pictures = next(reader), list(reader)
    assert properties["size"] == (2 * WIDTH, HEIGHT)
    assert properties["fps"] == 12
    assert len(pictures) == 6
    assert not list(temporary.iterdir())


def test_ns_export_writes_a_point_cloud_in_the_world_of_the_rollout(shell, trained, tmp_path):
    words = ["--num-points", 3000, "--num-rays-per-batch", 1024, "--normal-method", "open3d"]
    to = ["--save-world-frame", "True", "--output-dir", tmp_path]
    succeeded(shell.run("ns-export", "pointcloud", "--load-config", trained, *words, *to))
    points, normals = points_and_normals(tmp_path / "point_cloud.ply")
    assert len(points) >= 2500
    assert normals.shape == points.shape
    assert (points > ROOM[0] - 0.4).all()
    assert (points < ROOM[1] + 0.4).all()


def test_ns_export_writes_a_mesh(shell, trained, tmp_path):
    words = ["--load-config", trained, "--output-dir", tmp_path, "--use-bounding-box", "False"]
    coarse = ["--resolution", 24, "--downscale-factor", 1, "--texture-method", "tsdf"]
    succeeded(shell.run("ns-export", "tsdf", *words, *coarse))
    assert triangles(tmp_path / "tsdf_mesh.ply") > 100


def test_training_goes_on_where_a_checkpoint_left_it(shell, trained, walk, tmp_path):
    models = trained.parent / "nerfstudio_models"
    config = train(
        shell.run, tmp_path, ["avp-nerfacto"], "--load-dir", models, "--data", walk, iterations=5, timestamp="more"
    )
    (_, before), (path, after) = checkpoint(trained), checkpoint(config)
    assert path.name == f"step-{ITERATIONS + 4:09d}.ckpt"
    assert after["step"] == before["step"] + 5
    assert set(after["optimizers"]) == set(before["optimizers"]) == {"fields", "proposal_networks"}
    for group in before["optimizers"]:
        steps = [content["optimizers"][group]["state"][0]["step"] for content in (before, after)]
        epochs = [content["schedulers"][group]["last_epoch"] for content in (before, after)]
        # nerfacto gives its proposal network a rest in some steps.
        assert steps[0] < steps[1] <= steps[0] + 5
        assert epochs == [ITERATIONS, ITERATIONS + 5]


def test_a_checkpoint_that_runs_code_is_refused_by_name(shell, trained, walk, tmp_path):
    target = tmp_path / "made-by-a-checkpoint"
    config = copy_with(trained, tmp_path, payload=RunsCode(target))
    models = config.parent / "nerfstudio_models"
    words = ["avp-nerfacto", "--load-dir", models, "--output-dir", tmp_path / "out", "--data", walk]
    line = only_line(shell.run("ns-train", *words))
    assert line.startswith(f"error: {models}: expected the tensors and numbers of a nerfstudio checkpoint, found ")
    assert ".mkdir, which could run code" in line
    assert shell.run("ns-eval", "--load-config", config, "--output-path", tmp_path / "s.json").returncode == 1
    assert not target.exists()


def test_ns_viewer_serves_a_checkpoint_on_loopback_only(shell, trained):
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    host = ["--viewer.websocket-host", "127.0.0.1", "--viewer.websocket-port", port]
    pid = shell.start("ns-viewer", "--load-config", trained, *host)
    try:
        page = wait_for_page(f"http://127.0.0.1:{port}/", seconds=60)
        listening = addresses_listening_on(port)
    finally:
        os.kill(pid, signal.SIGTERM)
        done = shell.wait(pid)
    assert b"<html" in page, done.stdout + done.stderr
    assert listening == {"0100007F"}
    assert done.returncode == -signal.SIGTERM


def wait_for_page(address, seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(address, timeout=5) as page:
                return page.read()
        except OSError:
            time.sleep(0.2)
    return b""


def addresses_listening_on(port):
    """As the kernel writes them, low byte first: 0100007F is 127.0.0.1, 00000000 any."""
    rows = [line.split() for file in ("tcp", "tcp6") for line in Path(f"/proc/net/{file}").read_text().splitlines()]
    return {row[1].split(":")[0] for row in rows if row[3] == "0A" and row[1].endswith(f":{port:04X}")}


def executable(name, *arguments, environment=None):
    """The installed program itself."""
    return subprocess.run(
        [Path(sys.executable).parent / name, *map(str, arguments)],
        env={**os.environ, "COLUMNS": "300", **(environment or {})},
        capture_output=True,
        text=True,
        timeout=500,
    )


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("method", [["avp-nerfacto"], PLAIN], ids=lambda method: method[0])
def test_every_installed_program_works_on_a_checkpoint(walk, tmp_path, shared, method):
    weights = {"TORCH_HOME": str(shared / "torch_home")}
    data = ["--data", walk] if method[0] == "avp-nerfacto" else ["avp-data", "--data", walk]
    config = train(executable, tmp_path, method, *data, iterations=3, environment=weights)
    load = ["--load-config", config]
    succeeded(executable("ns-eval", *load, "--output-path", tmp_path / "s.json", environment=weights))
    assert {"psnr", "ssim", "lpips"} <= set(json.loads((tmp_path / "s.json").read_text())["results"])
    film = ["--output-path", tmp_path / "a.mp4", "--interpolation-steps", 2]
    succeeded(executable("ns-render", "interpolate", *load, *film, environment=weights))
    assert (tmp_path / "a.mp4").stat().st_size > 500
    cloud = ["--num-points", 1000, "--num-rays-per-batch", 512, "--normal-method", "open3d", "--output-dir", tmp_path]
    succeeded(executable("ns-export", "pointcloud", *load, *cloud, environment=weights))
    assert len(points_and_normals(tmp_path / "point_cloud.ply")[0]) > 500
    texture = ["--texture-method", "point_cloud"]
    succeeded(executable("ns-export", "poisson", *load, *cloud, *texture, environment=weights))
    assert triangles(tmp_path / "poisson_mesh.ply") > 100
    more = ["--load-dir", config.parent / "nerfstudio_models", *data]
    resumed = train(executable, tmp_path, method, *more, iterations=2, timestamp="more", environment=weights)
    assert checkpoint(resumed)[1]["step"] == 4


@pytest.mark.slow
def test_a_damaged_rollout_ends_ns_train_with_one_line(tmp_path):
    room = write_room(tmp_path / "room", frames=2, heldout=1)
    (room / "images/frame_00001.png").unlink()
    done = executable("ns-train", "avp-nerfacto", "--output-dir", tmp_path / "out", "--data", room)
    assert only_line(done).startswith(f"error: {room}/images/frame_00001.png: expected this file")
