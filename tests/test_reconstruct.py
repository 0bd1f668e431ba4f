import json
import multiprocessing
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from nerfstudio_room import write_room

pytest.importorskip("nerfstudio")

from avp_habitat import command
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.images import read_rgb
from avp_habitat.rollout.seen import visibility_of
from avp_nerfstudio import reconstruct
from avp_nerfstudio.method.checkpoints import TrainedRunError, config_path
from avp_nerfstudio.reconstruct import Reconstruct

ITERATIONS = ("--iterations", "3")


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("rooms") / "room", frames=5, heldout=3)


@pytest.fixture(autouse=True)
def no_weights(tmp_path_factory, monkeypatch):
    """The room's pictures are too small for LPIPS, which says so without looking for weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path_factory.mktemp("torch")))


def run(*words):
    return command.run(reconstruct.main, [str(word) for word in words])


def scores_of(folder):
    return json.loads((folder / "scores.json").read_text())


def test_a_reconstruction_leaves_scores_pictures_and_nothing_else(room, tmp_path, capfd):
    out = tmp_path / "a" / "out"
    assert run(room, "--out", out, *ITERATIONS, "--frames", 2, "--seed", 7, "--pictures", 2) == 0
    found = scores_of(out)
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    assert sorted(str(path.relative_to(out)) for path in out.rglob("*.*")) == [
        "pictures/render_00002.png",
        "pictures/truth_00002.png",
        "scores.json",
    ]
    assert {key: found[key] for key in ("format", "method", "iterations", "frames", "seed")} == {
        "format": "avp-reconstruction",
        "method": "avp-nerfacto",
        "iterations": 3,
        "frames": 2,
        "seed": 7,
    }
    assert [row["name"] for row in found["per_view"]] == [f"frame_{i:05d}.png" for i in range(3)]
    for name in ("psnr", "ssim"):
        assert found["scores"][name] == pytest.approx(np.mean([row[name] for row in found["per_view"]]))
    assert "lpips" not in found["scores"]
    assert "smaller than" in found["lpips_reason"]
    assert set(found["seconds"]) == {"start", "train", "score"}
    assert found["versions"]["nerfstudio"]
    printed = capfd.readouterr()
    assert printed.out.startswith(f"{out}: psnr ")
    assert printed.out.count("\n") == 1
    assert "warn" not in printed.err.lower()


def test_pictures_and_visibility_are_those_of_the_rollout(room, tmp_path):
    found = reconstruct.reconstruct(Reconstruct(room, tmp_path / "out", iterations=3, frames=2, pictures=(1,)))
    rollout = read_rollout(room)
    seen = visibility_of(rollout.frames[:2], rollout.heldout, rollout.intrinsics)
    assert found["visibility"]["visibility"] == seen.figures()["visibility"]
    assert found["visibility"]["per_view"] == seen.per_view().tolist()
    truth, render = (read_rgb(tmp_path / "out" / "pictures" / f"{kind}_00001.png") for kind in ("truth", "render"))
    np.testing.assert_array_equal(truth, read_rgb(rollout.heldout[1].image))
    error = np.mean((truth / 255.0 - render / 255.0) ** 2)
    assert found["per_view"][1]["psnr"] == pytest.approx(-10 * np.log10(error), abs=0.05)


def test_the_seed_decides_and_frames_and_depth_matter(room, tmp_path):
    def psnr(name, **options):
        return reconstruct.reconstruct(Reconstruct(room, tmp_path / name, iterations=3, **options))["scores"]["psnr"]

    first = psnr("a", seed=1)
    assert psnr("b", seed=1) == first
    assert psnr("c", seed=2) != first
    assert psnr("d", seed=1, frames=1) != first
    assert psnr("e", seed=1, depth=False) != first


@pytest.mark.filterwarnings("ignore")  # of nerfstudio's own command
def test_a_kept_checkpoint_opens_where_the_folder_is_and_scores_the_same(room, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert run(room, "--out", out, *ITERATIONS, "--keep-checkpoint") == 0
    found = scores_of(out)
    assert config_path(out) == out / found["config"]
    (out / "scores.json").write_text(json.dumps({**found, "config": None}))
    with pytest.raises(TrainedRunError, match="kept no checkpoint"):
        config_path(out)
    from nerfstudio.scripts.eval import ComputePSNR

    monkeypatch.chdir(tmp_path)
    ComputePSNR(load_config=out / found["config"], output_path=tmp_path / "eval.json").main()
    results = json.loads((tmp_path / "eval.json").read_text())["results"]
    assert results["psnr"] == pytest.approx(found["scores"]["psnr"], abs=1e-4)
    assert results["ssim"] == pytest.approx(found["scores"]["ssim"], abs=1e-4)


def forked(words, sent):
    sent.send(command.run(reconstruct.main, words))


@pytest.mark.slow  # two processes import nerfstudio
def test_a_fork_of_a_preloaded_process_scores_the_same(room, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    words = [str(room), "--iterations", "3", "--seed", "5"]
    done = subprocess.run(
        [sys.executable, "-m", "avp_nerfstudio.reconstruct", *words, "--out", str(tmp_path / "fresh")],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["avp_nerfstudio.method.reconstruction"])
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=forked, args=([*words, "--out", str(tmp_path / "fork")], send))
    process.start()
    assert receive.poll(300)
    assert receive.recv() == 0
    process.join(60)
    fresh, fork = (scores_of(tmp_path / name)["scores"] for name in ("fresh", "fork"))
    assert fork == pytest.approx(fresh, abs=1e-6)


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["--method", "nerfactor"], 2, "nerfactor"),
        (["--frames", "0"], 2, "--frames: expected 1 to 5"),
        (["--frames", "6"], 2, "--frames: expected 1 to 5"),
        (["--iterations", "0"], 2, "--iterations: expected a number from 1, got 0"),
        (["--seed", "-1"], 2, "--seed: expected a whole number from 0"),
        (["--pictures", "0", "3"], 2, "--pictures: expected 0 to 2"),
    ],
)
def test_an_option_that_cannot_be_right_is_one_line_and_leaves_nothing(room, tmp_path, capfd, words, code, text):
    assert run(room, "--out", tmp_path / "out", *words) == code
    printed = capfd.readouterr()
    assert text in printed.err
    assert printed.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_missing_or_damaged_rollout_and_a_folder_that_exists_are_refused(room, tmp_path, capfd):
    assert run(tmp_path / "none", "--out", tmp_path / "out") == 1
    assert "expected a rollout folder" in capfd.readouterr().err
    assert run(room, "--out", room) == 2
    assert "exists already" in capfd.readouterr().err
    damaged = write_room(tmp_path / "damaged", frames=2, heldout=1)
    picture = read_rollout(damaged).frames[1].image
    content = bytearray(picture.read_bytes())
    content[len(content) // 2] ^= 0xFF
    picture.write_bytes(content)
    assert run(damaged, "--out", tmp_path / "out", *ITERATIONS) == 1
    error = capfd.readouterr().err
    assert "frame_00001.png" in error
    assert "Traceback" not in error
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_training_leaves_nothing(room, tmp_path, monkeypatch, capfd, number):
    from avp_nerfstudio.method.trainer import AVPTrainer

    iterate = AVPTrainer.train_iteration

    def interrupted(self, step):
        os.kill(os.getpid(), number)
        return iterate(self, step)

    monkeypatch.setattr(AVPTrainer, "train_iteration", interrupted)
    assert run(room, "--out", tmp_path / "out", "--iterations", "100000") == command.INTERRUPTED
    assert "interrupted" in capfd.readouterr().err
    assert list(tmp_path.iterdir()) == []
