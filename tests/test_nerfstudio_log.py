import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from nerfstudio_room import write_room
from tracking import mlflow_home

pytest.importorskip("nerfstudio")

import torch
from mlflow import MlflowClient
from nerfstudio.configs.method_configs import all_methods
from nerfstudio.scripts import eval as ns_eval
from nerfstudio_training import tiny_config, train
from PIL import Image
from rrd import entities, rows, verify
from torchmetrics.functional import structural_similarity_index_measure
from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

import avp_nerfstudio.log
from avp_habitat import command
from avp_habitat.rollout.images import read_rgb
from avp_nerfstudio.data.dataparser import AVPDataParserConfig
from avp_nerfstudio.method.checkpoints import open_trained, read_config
from avp_nerfstudio.method.scores import HeldoutView, error_colours, render_views, triptych

SIZE = (64, 48)


@pytest.fixture(scope="module", autouse=True)
def no_downloads(tmp_path_factory):
    """LPIPS is computed where the weights lie beside the checkout and left out elsewhere."""
    weights = Path(__file__).resolve().parents[2] / "shared/torch_home"
    before = {name: os.environ.get(name) for name in ("TORCH_HOME", "https_proxy")}
    os.environ["TORCH_HOME"] = str(weights if weights.is_dir() else tmp_path_factory.mktemp("weights"))
    os.environ["https_proxy"] = "http://127.0.0.1:9"
    yield
    for name, value in before.items():
        os.environ.pop(name) if value is None else os.environ.update({name: value})


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The config.yml of one training for all tests; none of them changes its folder."""
    folder = tmp_path_factory.mktemp("trained")
    room = write_room(folder / "room", width=SIZE[0], height=SIZE[1], heldout=3)
    return train(tiny_config(room, folder, iterations=40))


@pytest.fixture
def copy(trained, tmp_path):
    """The config.yml of a copy of that training, in another place."""
    return shutil.copytree(trained.parent, tmp_path / "copy") / "config.yml"


@pytest.fixture
def store(tmp_path, monkeypatch):
    return MlflowClient(mlflow_home(tmp_path, monkeypatch))


def log(*arguments):
    return command.run(avp_nerfstudio.log.main, [str(argument) for argument in arguments])


def runs(client):
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    return client.search_runs(experiments, "tags.avp.kind = 'reconstruction'")


def made_up_view(scores):
    truth = np.zeros((48, 120, 3), np.float32)
    render = truth.copy()
    render[:, :60] = 0.25
    render[:, :30] = 1.0
    return HeldoutView(0, "frame_00000.png", truth, render, scores, 1.0, None)


def test_ns_evals_scores_equal_an_independent_computation_on_saved_renders(trained, tmp_path, shared):
    ns_eval.ComputePSNR(load_config=trained, output_path=tmp_path / "scores.json").main()
    theirs = json.loads((tmp_path / "scores.json").read_text())["results"]
    # Renders are saved as the numbers they are: nerfstudio's own pictures of them have 8 bits.
    for view in render_views(open_trained(read_config(trained)).pipeline):
        np.save(tmp_path / f"{view.name}.npy", view.render)
    pairs = []
    for path in sorted((trained.parents[3] / "room/heldout/images").glob("*.png")):
        truth, render = read_rgb(path) / np.float32(255), np.load(tmp_path / f"{path.name}.npy", allow_pickle=False)
        assert render.shape == (48, 64, 3)
        pairs.append([torch.from_numpy(picture).permute(2, 0, 1)[None] for picture in (truth, render)])
    assert len(pairs) == 3
    lpips = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True)
    psnr = np.mean([10 * np.log10(1 / np.mean((truth - render).double().numpy() ** 2)) for truth, render in pairs])
    ours = {
        "psnr": psnr,
        "ssim": np.mean([structural_similarity_index_measure(render, truth).item() for truth, render in pairs]),
        "lpips": np.mean([lpips(render, truth).item() for truth, render in pairs]),
    }
    assert {name: theirs[name] for name in ours} == pytest.approx(ours, rel=1e-5)


def test_a_training_of_before_becomes_a_run_with_its_losses_scores_and_pictures(trained, copy, tmp_path, store, capsys):
    ns_eval.ComputePSNR(load_config=trained, output_path=tmp_path / "scores.json").main()
    theirs = json.loads((tmp_path / "scores.json").read_text())["results"]
    assert log(copy, "--pictures", 2) == 0
    (run,) = runs(store)
    assert run.info.status == "FINISHED"
    for name in {"psnr", "ssim", "lpips"} & set(theirs):
        assert run.data.metrics[f"eval/{name}"] == pytest.approx(theirs[name], rel=1e-6)
    assert [m.step for m in store.get_metric_history(run.info.run_id, "eval/psnr")] == [39]
    assert [m.step for m in store.get_metric_history(run.info.run_id, "Train Loss")] == list(range(0, 40, 5))
    assert [m.step for m in store.get_metric_history(run.info.run_id, "learning_rate/fields")] == list(range(0, 40, 5))
    pictures = {file.path for file in store.list_artifacts(run.info.run_id, "heldout")}
    assert pictures == {"heldout/heldout.json", "heldout/view_00000.png", "heldout/view_00002.png"}
    assert {file.path for file in store.list_artifacts(run.info.run_id)} >= {"config.yml", "heldout"}
    table = json.loads((copy.parent / "heldout/heldout.json").read_text())
    assert table["step"] == 39
    assert [view["name"] for view in table["views"]] == [f"frame_{i:05d}.png" for i in range(3)]
    assert np.mean([view["psnr"] for view in table["views"]]) == pytest.approx(table["mean"]["psnr"])
    told = capsys.readouterr().out
    assert f"psnr                 {theirs['psnr']:.4f}" in told
    assert run.info.run_id in told


def test_logging_again_goes_on_in_the_same_run(copy, store):
    assert log(copy, "--pictures", 0) == 0
    (before,) = runs(store)
    assert log(copy.parent, "--pictures", 1, "--experiment", "another") == 0
    (after,) = runs(store)
    assert after.info.run_id == before.info.run_id
    assert len(store.get_metric_history(after.info.run_id, "Train Loss")) == 8
    assert len(store.get_metric_history(after.info.run_id, "eval/psnr")) == 2


def test_a_recording_shows_each_held_out_view_at_its_place(copy, tmp_path):
    path = tmp_path / "log.rrd"
    assert log(copy, "--mlflow", "off", "--rerun", path, "--output", tmp_path / "out") == 0
    verify(path)
    assert {"/pictures/truth", "/pictures/render", "/pictures/error", "/world/camera/render"} <= entities(path)
    places = rows(path, "/world/camera", "Transform3D:translation", timeline="view")
    cameras = open_trained(read_config(copy)).pipeline.datamanager.eval_dataset.cameras
    assert [index for index, _ in places] == [0, 1, 2]
    np.testing.assert_allclose([place for _, place in places], cameras.camera_to_worlds[:, :, 3], atol=1e-5)
    scores = rows(path, "/scores/psnr", "Scalars:scalars", timeline="view")
    table = json.loads((tmp_path / "out/heldout.json").read_text())
    assert [score.item() for _, score in scores] == pytest.approx([view["psnr"] for view in table["views"]])
    assert not (copy.parent / "mlflow_run_id.txt").exists()


@pytest.mark.slow  # plain nerfacto reads its data in processes of its own, which import everything again
def test_plain_nerfacto_is_logged_too(tmp_path, store, shared):
    room = write_room(tmp_path / "room", width=SIZE[0], height=SIZE[1], heldout=1)
    ours = tiny_config(room, tmp_path)
    config = all_methods["nerfacto"].__class__(**{**vars(all_methods["nerfacto"]), "method_name": "nerfacto"})
    config.machine, config.logging, config.vis = ours.machine, ours.logging, "tensorboard"
    config.data, config.output_dir = room, tmp_path
    config.experiment_name, config.timestamp, config.max_num_iterations = "e", "t", 6
    config.mixed_precision = False
    config.pipeline.datamanager.dataparser = AVPDataParserConfig()
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    model = config.pipeline.model
    model.implementation, model.log2_hashmap_size = "torch", 8
    model.num_proposal_samples_per_ray, model.num_nerf_samples_per_ray = (16, 8), 8
    assert log(train(config)) == 0
    (run,) = runs(store)
    assert run.data.tags["avp.method"] == "nerfacto"
    assert run.data.tags["avp.rollout"] == str(room)
    assert {"eval/psnr", "eval/ssim", "eval/lpips", "Train Loss"} <= set(run.data.metrics)


def test_the_picture_shows_truth_render_and_error_side_by_side():
    shown = triptych(made_up_view({"psnr": 20.0, "ssim": 0.5, "lpips": 0.1}))
    strip = shown.shape[0] - 48
    assert shown.shape == (48 + strip, 360, 3)
    truth, render, error = (shown[strip:, column * 120 : (column + 1) * 120] for column in range(3))
    assert truth.max() == 0
    assert (render[:, :30] == 255).all()
    assert (render[:, 30:60] == 64).all()
    assert (render[:, 60:] == 0).all()
    assert (error == error_colours(made_up_view({}))).all()
    # A quarter of full scale and more has the last colour, no error the first.
    assert (error[:, :60] == [252, 253, 190]).all()
    assert (error[:, 60:] == 0).all()
    assert shown[:strip, 120:].max() > 200


def test_the_saved_picture_holds_the_true_picture(copy, tmp_path, trained):
    assert log(copy, "--mlflow", "off", "--output", tmp_path / "out") == 0
    picture = np.asarray(Image.open(tmp_path / "out/view_00001.png"))
    truth = read_rgb(trained.parents[3] / "room/heldout/images/frame_00001.png")
    assert (picture[-48:, :64] == truth).all()


def test_a_missing_or_foreign_config_is_named(tmp_path, capsys):
    (tmp_path / "config.yml").write_text("a: 1\n")
    (tmp_path / "broken.yml").write_text("!!python/object:no.such.Thing {}\n")
    for name, text in (
        ("none.yml", "expected the config.yml that ns-train wrote, found none"),
        ("config.yml", "found a dict instead of settings"),
        ("broken.yml", "could not read it"),
    ):
        assert log(tmp_path / name, "--mlflow", "off") == 1
        told = capsys.readouterr().err
        assert told.startswith(f"error: {tmp_path / name}: ")
        assert text in told
        assert told.count("\n") == 1


def test_nothing_but_the_error_is_said(tmp_path):
    (tmp_path / "config.yml").write_text("a: 1\n")
    line = [sys.executable, "-m", "avp_nerfstudio.log", tmp_path / "config.yml", "--mlflow", "off"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


def test_a_missing_checkpoint_is_named(copy, capsys):
    for checkpoint in (copy.parent / "nerfstudio_models").iterdir():
        checkpoint.unlink()
    assert log(copy, "--mlflow", "off") == 1
    assert f"{copy.parent / 'nerfstudio_models'}: expected a checkpoint (step-*.ckpt)" in capsys.readouterr().err


class Foreign:
    """A type that no checkpoint of nerfstudio holds."""


def test_a_checkpoint_with_a_foreign_type_is_refused_by_name(copy, capsys):
    (checkpoint,) = (copy.parent / "nerfstudio_models").iterdir()
    torch.save({"step": 1, "pipeline": Foreign()}, checkpoint)
    assert log(copy, "--mlflow", "off") == 1
    told = capsys.readouterr().err.splitlines()[-1]
    assert told.startswith(f"error: {checkpoint}: ")
    assert "test_nerfstudio_log.Foreign" in told


def test_a_rollout_that_has_gone_is_named(copy, capsys):
    text = copy.read_text()
    assert "- room\n" in text
    copy.write_text(text.replace("- room\n", "- gone\n"))
    assert log(copy, "--mlflow", "off") == 1
    assert "gone: expected a rollout folder" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("options", "code", "text"),
    [
        (["--pictures", "-1"], 2, "--pictures: expected a whole number from 0 to 1,000,000,000, got -1"),
        (["--rerun", __file__], 2, "exists already"),
        (["--output", __file__], 2, "cannot make this folder"),
        (["--mlflow", "nonsense://host"], 1, "MLflow at nonsense://host cannot be used"),
    ],
)
def test_a_wrong_option_is_named_before_anything_is_rendered(trained, options, code, text, capsys):
    if "--mlflow" not in options:
        options = [*options, "--mlflow", "off"]
    assert log(trained, *options) == code
    told = capsys.readouterr()
    assert text in told.err
    assert "Setting up" not in told.out
