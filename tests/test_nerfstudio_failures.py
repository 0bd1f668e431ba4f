"""How the `ns-` commands end when they cannot do what they are asked, and what they say when they can."""

import re
import shlex
import shutil

import pytest
import torch
from nerfstudio_room import write_room
from nerfstudio_shell import Shell

from avp_habitat import provenance

pytest.importorskip("nerfstudio")

SMALL = ["--pipeline.datamanager.train-num-rays-per-batch", 32, "--pipeline.model.log2-hashmap-size", 8]
no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is there")


@pytest.fixture(scope="module")
def shell():
    with Shell() as shell:
        yield shell


@pytest.fixture(scope="module")
def place(shell, tmp_path_factory):
    """A folder with a rollout, and a training of it with relative paths, as the README has them."""
    folder = tmp_path_factory.mktemp("place")
    write_room(folder / "runs/r0", frames=3, heldout=1)
    done = train(shell, folder, "avp-nerfacto", *SMALL, "--timestamp", "t", "--data", "runs/r0")
    assert done.returncode == 0, done.stderr
    (folder / "train.txt").write_text(done.stdout + done.stderr)
    return folder


CONFIG = "outputs/r0/avp-nerfacto/t/config.yml"


def train(shell, cwd, *words):
    iterations = ["--max-num-iterations", 2, "--viewer.quit-on-train-completion", "True"]
    return shell.run("ns-train", words[0], *iterations, *words[1:], cwd=cwd)


def last_line(done):
    assert done.returncode == 1, done.stdout + done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    return done.stderr.splitlines()[-1]


def commands(line):
    return [shlex.split(part) for part in line.split("`")[1::2]]


@no_gpu
@pytest.mark.parametrize("method", ["nerfacto", "depth-nerfacto"])
def test_a_training_for_a_gpu_that_is_not_there_names_commands_that_work_here(shell, place, tmp_path, method):
    line = last_line(train(shell, tmp_path, method, "avp-data", "--data", place / "runs/r0"))
    assert line.startswith(f"error: {method} is to train on a GPU, and none was found here (torch ")
    ours, plain = commands(line)
    assert ours == ["ns-train", "avp-nerfacto", "--data", f"{place}/runs/r0"]
    assert plain == ["ns-train", method, *provenance.WITHOUT_GPU.split(), "avp-data", "--data", f"{place}/runs/r0"]
    assert list(tmp_path.iterdir()) == []


@no_gpu
@pytest.mark.slow
def test_the_command_for_this_machine_trains(shell, place, shared, tmp_path):
    name, method, *options = commands(
        last_line(train(shell, tmp_path, "nerfacto", "avp-data", "--data", place / "runs/r0"))
    )[1]
    plain = [name, method, *SMALL, "--max-num-iterations", 2, "--viewer.quit-on-train-completion", "True", *options]
    weights = {"TORCH_HOME": str(shared / "torch_home")}
    done = shell.run(*plain, cwd=tmp_path, environment=weights)
    assert done.returncode == 0, done.stderr
    assert len(list(tmp_path.glob("outputs/*/nerfacto/*/nerfstudio_models/*.ckpt"))) == 1


@no_gpu
def test_a_method_that_needs_a_gpu_is_not_offered_a_cpu(shell, place, tmp_path):
    line = last_line(shell.run("ns-train", "splatfacto", "avp-data", "--data", place / "runs/r0", cwd=tmp_path))
    assert "device-type" not in line
    assert line.endswith(f"use `ns-train avp-nerfacto --data {place}/runs/r0`, made for this machine")


@pytest.mark.parametrize("method", [["avp-nerfacto"], ["nerfacto", "--machine.device-type", "cpu"]], ids=lambda m: m[0])
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("nothing", "nothing: expected a rollout folder .*the path is relative to"),
        ("colmap", "colmap: expected a rollout .*a COLMAP project"),
        ("damaged", r"damaged/heldout/images/frame_00000\.png: expected"),
    ],
)
def test_a_training_that_cannot_start_leaves_no_folder(shell, place, tmp_path, method, name, text):
    (tmp_path / "colmap/sparse/0").mkdir(parents=True)
    (tmp_path / "colmap/sparse/0/cameras.txt").touch()
    shutil.copytree(place / "runs/r0", tmp_path / "damaged")
    (tmp_path / "damaged/heldout/images/frame_00000.png").write_bytes(b"<html>")
    data = ["--data", name] if method == ["avp-nerfacto"] else ["avp-data", "--data", name]
    (tmp_path / "outputs").mkdir()
    (tmp_path / "outputs/notes.txt").touch()
    assert_matches(f"^error: {text}", last_line(shell.run("ns-train", *method, *data, cwd=tmp_path)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["colmap", "damaged", "outputs"]
    assert [path.name for path in (tmp_path / "outputs").iterdir()] == ["notes.txt"]


def assert_matches(pattern, text):
    assert re.search(pattern, text), text


@pytest.mark.parametrize("words", [["ns-eval"], ["ns-render", "dataset"]], ids=lambda words: words[0])
def test_opening_a_training_from_another_folder_says_what_its_paths_are_relative_to(shell, place, tmp_path, words):
    line = last_line(shell.run(*words, "--load-config", place / CONFIG, cwd=tmp_path))
    assert line == (
        "error: runs/r0: expected a rollout folder (made by `python -m avp_habitat.collect`), found none; the path is "
        f"relative to the folder where ns-train ran, now {tmp_path}"
    )


def test_a_training_shows_what_matters_and_no_known_warnings(place):
    text = (place / "train.txt").read_text()
    assert "avp-nerfacto: 2 iterations with runs/r0 on " in text
    assert "Warning" not in text
    assert len(text.splitlines()) < 30
