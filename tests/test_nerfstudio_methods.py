"""nerfstudio's own methods on `avp-data`: what its pipelines make of the parser's outputs."""

import copy
import json

import numpy as np
import pytest
import torch
from nerfstudio_room import distance_to_walls, write_room
from nerfstudio_shell import Shell

from avp_habitat.poses import z_up_to_y_up
from avp_habitat.rollout.images import read_depth

pytest.importorskip("nerfstudio")

# nerfstudio's modules import each other in circles; this way round is its own.
from nerfstudio.configs.method_configs import method_configs

from avp_nerfstudio.data.dataparser import AVPDataParserConfig
from avp_nerfstudio.method.scores import optional_lpips


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("rollouts") / "room")


def pipeline_config(method, **options):
    config = copy.deepcopy(method_configs[method].pipeline)
    config.datamanager.dataparser = AVPDataParserConfig(**options)
    return config


def depth_nerfacto(room, **options):
    config = pipeline_config("depth-nerfacto", data=room, **options)
    config.datamanager.train_num_rays_per_batch = 64
    model = config.model
    model.implementation, model.log2_hashmap_size, model.num_levels = "torch", 8, 4
    model.proposal_net_args_list = [{**entry, "log2_hashmap_size": 8} for entry in model.proposal_net_args_list]
    with optional_lpips():
        return config.setup(device="cpu", test_mode="val")


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_depth_nerfacto_trains_with_the_rollouts_depth_in_the_units_of_the_scene(room, scale):
    pipeline = depth_nerfacto(room, scale=scale)
    pipeline.train()
    rays, batch = pipeline.datamanager.next_train(0)
    files = pipeline.datamanager.train_dataparser_outputs.metadata["depth_filenames"]
    truth = [read_depth(files[image])[row, column] for image, row, column in batch["indices"].tolist()]
    np.testing.assert_allclose(batch["depth_image"][:, 0], scale * np.array(truth), atol=1e-5)
    # nerfstudio's own reading of a depth along the axis, not along the ray, must be the default.
    assert pipeline.model.config.is_euclidean_depth is False
    along = batch["depth_image"] * rays.metadata["directions_norm"]
    points = (rays.origins + rays.directions * along).numpy() / scale
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    assert distance_to_walls(z_up_to_y_up(homogeneous[..., None])[:, :3, 0]).max() < 0.005
    _, losses, metrics = pipeline.get_train_loss_dict(1)
    assert torch.isfinite(metrics["depth_loss"])
    assert metrics["depth_loss"] > 0
    losses["depth_loss"].backward()
    assert any(parameter.grad is not None and parameter.grad.any() for parameter in pipeline.model.field.parameters())


def test_splatfacto_begins_with_the_points_that_the_depth_shows(room):
    pytest.importorskip("gsplat")
    outputs = AVPDataParserConfig(data=room, initial_points=200).setup().get_dataparser_outputs()
    points, colours = outputs.metadata["points3D_xyz"], outputs.metadata["points3D_rgb"]
    if not torch.cuda.is_available():
        # nerfstudio moves the colours to CUDA, so without a device only the points can be tried.
        colours = colours[:0]
    with optional_lpips():
        model = method_configs["splatfacto"].pipeline.model.setup(
            scene_box=outputs.scene_box,
            num_train_data=6,
            metadata=outputs.metadata,
            device="cpu",
            seed_points=(points, colours),
        )
    assert torch.equal(model.means.data.cpu(), points)
    assert torch.isfinite(model.scales).all()


@pytest.fixture(scope="module")
def shell():
    with Shell() as started:
        yield started


@pytest.fixture(scope="module")
def big_room(tmp_path_factory):
    """Pictures that AlexNet and SSIM can score."""
    return write_room(tmp_path_factory.mktemp("big") / "room", width=80, height=64)


CPU = ["--machine.device-type", "cpu", "--mixed-precision", "False", "--vis", "tensorboard"]
SMALL = [
    *("--pipeline.datamanager.train-num-rays-per-batch", 64),
    *("--pipeline.model.implementation", "torch"),
    *("--pipeline.model.log2-hashmap-size", 8),
]


def train(shell, folder, method, *words, environment=None):
    out = ["--output-dir", folder, "--experiment-name", "e", "--timestamp", "t", "--max-num-iterations", 3]
    done = shell.run("ns-train", method, *out, *words, environment=environment)
    return done, folder / "e" / method / "t" / "config.yml"


@pytest.mark.slow
def test_depth_nerfacto_trains_and_is_scored_by_the_real_commands(shell, big_room, tmp_path, shared):
    weights = {"TORCH_HOME": str(shared / "torch_home")}
    words = [*CPU, *SMALL, "avp-data", "--data", big_room]
    done, config = train(shell, tmp_path, "depth-nerfacto", *words, environment=weights)
    assert done.returncode == 0, done.stdout + done.stderr
    scores = tmp_path / "s.json"
    done = shell.run("ns-eval", "--load-config", config, "--output-path", scores, environment=weights)
    assert done.returncode == 0, done.stdout + done.stderr
    results = json.loads(scores.read_text())["results"]
    assert results["depth_mse"] > 0
    assert 3 < results["psnr"] < 60


@pytest.mark.slow
def test_nerfacto_trains_on_merged_rollouts_ordered_and_without_depth(shell, tmp_path, shared):
    folders = [write_room(tmp_path / name, width=80, height=64, frames=3) for name in ("one", "two")]
    for folder in folders:
        meta = json.loads((folder / "rollout.json").read_text()) | {"scene": {"name": "a formula", "sha256": "00"}}
        (folder / "rollout.json").write_text(json.dumps(meta))
    options = ["--order", "spread", "--max-views", 5, "--depth", "False", "--verify", "True"]
    words = [*CPU, *SMALL, "avp-data", "--data", folders[0], "--also", folders[1], *options]
    done, config = train(shell, tmp_path, "nerfacto", *words, environment={"TORCH_HOME": str(shared / "torch_home")})
    assert done.returncode == 0, done.stdout + done.stderr
    assert "order: spread" in config.read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "words", "text"),
    [
        (lambda f: (f / "images/frame_00001.png").unlink(), [], "{f}/images/frame_00001.png: expected this file"),
        (lambda f: (f / "poses/frame_00001.txt").write_text("nan " * 16), [], "{f}/poses/frame_00001.txt: not a rigid"),
        (lambda f: None, ["--also", "{f}"], "{f}: expected each rollout once, it is named twice"),
        (lambda f: None, ["--every", "0"], "avp-data: every: expected a whole number from 1 to 1,000,000, got 0"),
    ],
    ids=["missing picture", "NaN pose", "named twice", "impossible option"],
)
def test_bad_input_ends_ns_train_with_one_line(shell, tmp_path, spoil, words, text):
    room = write_room(tmp_path / "room", frames=2, heldout=1)
    spoil(room)
    words = [*CPU, "avp-data", "--data", room, *(word.format(f=room) for word in words)]
    done, _ = train(shell, tmp_path, "nerfacto", *words)
    assert done.returncode == 1
    assert "Traceback" not in done.stdout + done.stderr
    assert done.stderr.splitlines()[-1].startswith("error: " + text.format(f=room))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat and nerfacc need a CUDA device")
@pytest.mark.parametrize("method", ["splatfacto", "instant-ngp", "instant-ngp-bounded"])
def test_methods_that_need_cuda_train(shell, big_room, tmp_path, shared, method):
    weights = {"TORCH_HOME": str(shared / "torch_home")}
    done, _ = train(
        shell, tmp_path, method, "--vis", "tensorboard", "avp-data", "--data", big_room, environment=weights
    )
    assert done.returncode == 0, done.stdout + done.stderr
