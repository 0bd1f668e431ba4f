"""The commands of docs/replica.md, taken from the page and run on rooms that lie on disk as Replica's do."""

import json
import math
import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import is_dataclass
from pathlib import Path
from types import ModuleType
from typing import get_type_hints

import numpy as np
import pytest
from replica_layout import replica_layout

from avp_habitat import collect, command
from avp_habitat.rollout.format import read_rollout
from avp_habitat.scenes.loader import load_scene
from avp_habitat.scenes.location import locate
from avp_habitat.tracking import compare
from avp_nerfstudio import log
from avp_sb3 import evaluate

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs" / "replica.md").read_text()
BLOCKS = re.findall(r"^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
REWARDS = ("coverage", "coverage_redundancy", "proposed")
ROOMS = {"room_0": "builtin:0", "room_2": "builtin:1"}
ON_A_CPU = (
    "--machine.device-type cpu --mixed-precision False --pipeline.model.implementation torch "
    "--pipeline.model.log2-hashmap-size 10 --pipeline.datamanager.train-num-rays-per-batch 128"
)
SHORTER = {
    "replica=/data/replica_v1": "replica=replica_v1",
    "--steps 300000": "--steps 2048 --width 32 --height 24",
    "--n-timesteps 300000": "--n-timesteps 2048",
    "--episodes 20": "--episodes 1 --width 32 --height 24",
    "--budget 80": "--budget 6 --width 64 --height 48",
    "--max-num-iterations 30000": f"--max-num-iterations 3 {ON_A_CPU}",
}
"""All of them shorten, but for the folder of the data."""
FEWER_RECONSTRUCTIONS = {"name in heuristic coverage coverage_redundancy proposed": "name in heuristic proposed"}
PROGRAMS = {
    "avp_habitat.collect": collect,
    "avp_sb3.evaluate": evaluate,
    "avp_nerfstudio.log": log,
    "avp_habitat.tracking.compare": compare,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("data") / "replica_v1"
    for name, room in ROOMS.items():
        replica_layout(folder, load_scene(room).mesh, name, dataset=name == "room_0")
    return folder


@pytest.fixture
def place(data, tmp_path, monkeypatch) -> Path:
    """An empty folder with what the page's commands name: the data, and the suite's examples."""
    (tmp_path / "replica_v1").symlink_to(data)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    return tmp_path


def blocks(**changes: str) -> list[str]:
    """The page's blocks, shortened, for a simulator."""
    page = "\0".join(BLOCKS)
    for text, shorter in {**SHORTER, **changes}.items():
        assert text in page, f"docs/replica.md has no {text!r} any more"
        page = page.replace(text, shorter)
    return page.split("\0")


def simulator(name: str) -> dict[str, str]:
    return {"simulator=habitat": f"simulator={name}"}


def run(folder: Path, texts: list[str], *, before: str = "", **environment: str) -> str:
    """All blocks in one bash, up to the first command that fails; what they wrote."""
    script = f"set -eu\n{before}\n" + "".join(
        f"{text}\necho {number} >> finished\n" for number, text in enumerate(texts)
    )
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with (folder / "output").open("w+") as output:
        line = ["bash", "-x", "-c", script]
        done = subprocess.run(
            line, cwd=folder, env={**os.environ, "PATH": path, **environment}, stdout=output, stderr=output, check=False
        )
        output.seek(0)
        text = output.read()
    assert done.returncode == 0, text[-5000:]
    assert (folder / "finished").read_text().split() == [str(number) for number in range(len(BLOCKS))]
    return text


def files_of(folder: Path) -> dict[str, tuple[int, int]]:
    return {
        str(path.relative_to(folder)): (path.stat().st_size, path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_every_command_of_the_page_stands_in_a_block_that_is_run():
    assert len(BLOCKS) == 9
    assert PAGE.count("```") == 2 * len(BLOCKS)
    rest = re.sub(r"^```sh\n.*?^```$", "", PAGE, flags=re.MULTILINE | re.DOTALL)
    assert not re.search(r"^ {4}(\$|python|ns-|rl_zoo3)", rest, re.MULTILINE)


def test_every_way_to_name_a_scene_that_the_page_lists_finds_room_0(place):
    ways = re.findall(r"`(replica_v1/[^`]*room_0[^`]*)`", PAGE)
    assert len(ways) == 5
    for way in ways:
        assert locate(way).name == "room_0"
    with pytest.raises(AssertionError, match="has no '--steps 200000' any more"):
        blocks(**{"--steps 200000": ""})


def words(folder: Path) -> list[list[str]]:
    """What bash gives to the programs, one list for each call; nothing is run."""
    programs = ("python", "ns-train", "ns-eval", "rl_zoo3")
    told = [f"{name}() {{ printf '%s\\0' {name} \"$@\" $'\\n' >> called; }}" for name in programs]
    run(folder, blocks(**simulator("raycast")), before="\n".join(told))
    calls = (folder / "called").read_text().removesuffix("\0").split("\0\n")
    return [[word for word in call.split("\0") if word] for call in calls if call]


def program_of(call: list[str]) -> tuple[str, list[str]]:
    """The program that a call is for, and the program's own words."""
    if call[0] != "python":
        return call[0], call[1:]
    return (call[2], call[3:]) if call[1] == "-m" else (call[1], call[2:])


def read(program: ModuleType, own: list[str]) -> None:
    """Have a program read its words."""
    kind = next(iter(get_type_hints(program.main).values()))
    if is_dataclass(kind):
        command.parse(kind, own)
    else:
        program._parser().parse_args(own)


def test_the_programs_of_the_suite_know_every_option_of_the_page(place):
    from avp_sb3 import train

    calls = [program_of(call) for call in words(place)]
    for name, own in calls:
        if name not in ("ns-train", "ns-eval", "rl_zoo3"):
            read({"avp_sb3.train": train, **PROGRAMS}[name], own)
    assert Counter(name for name, _ in calls) == {
        "avp_sb3.train": 4,
        "avp_sb3.evaluate": 5,
        "avp_habitat.collect": 5,
        "avp_nerfstudio.log": 5,
        "avp_habitat.tracking.compare": 2,
        "ns-train": 5,
        "ns-eval": 5,
        "rl_zoo3": 1,
    }


def test_a_policy_is_evaluated_captured_and_compared_in_room_2_as_the_page_says(place, data, monkeypatch):
    before = files_of(data)
    write_model(place / "runs" / "replica" / "proposed.zip")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "sqlite:///mlflow.db")
    for name, own in map(program_of, words(place)):
        if "replica_v1/room_2" in own or "runs/replica/comparison/room_2" in own:
            assert command.run(PROGRAMS[name].main, own) == 0
    assert read_rollout(place / "runs" / "replica" / "room_2" / "proposed").meta["scene"]["name"] == "room_2"
    kinds = {
        (row[0], row[2]) for row in rows_of(place / "runs" / "replica" / "comparison" / "room_2") if row[1] == "room_2"
    }
    assert kinds == {("heuristic", "evaluation"), ("proposed.zip", "evaluation"), ("proposed.zip", "rollout")}
    assert files_of(data) == before


def rows_of(comparison: Path) -> list[list[str]]:
    lines = (comparison / "comparison.md").read_text().splitlines()
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]


def write_model(path: Path) -> None:
    """A policy that was never trained."""
    from stable_baselines3 import PPO

    from avp_sb3 import AVPVecEnv

    path.parent.mkdir(parents=True, exist_ok=True)
    PPO("MlpPolicy", AVPVecEnv("builtin:0", agents=2), device="cpu", seed=0, n_steps=32, batch_size=64).save(path)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", ["raycast", pytest.param("habitat", marks=pytest.mark.habitat)])
def test_the_whole_page_runs_from_top_to_bottom(place, data, shared, name):
    before = files_of(data)
    weights, cache = str(shared / "torch_home"), str(place / "cache")
    texts = blocks(**simulator(name), **FEWER_RECONSTRUCTIONS)
    run(place, texts, TORCH_HOME=weights, AVP_CACHE=cache, PYTHONWARNINGS="ignore")
    results = place / "runs" / "replica"
    for model in (*REWARDS, "processes", "zoo/ppo/AVP-v0_1/AVP-v0"):
        assert (results / f"{model}.zip").is_file()
    rollouts = {policy: read_rollout(results / "room_0" / policy) for policy in ("heuristic", *REWARDS)}
    for policy, rollout in rollouts.items():
        assert rollout.meta["scene"]["name"] == "room_0"
        assert rollout.meta["simulator"]["name"] == name
        assert rollout.meta["reward"] == (policy if policy in REWARDS else "proposed")
        assert len(rollout.frames) <= 6
        assert same_poses(rollout.heldout, rollouts["proposed"].heldout)
        # A frame is taken after a step, and the first steps differ.
        first, other = (found.frames[0].camera_to_world[:3, 3] for found in (rollout, rollouts["proposed"]))
        assert np.linalg.norm(first - other) <= 0.25 + 1e-6
    for captured in ("room_0-heuristic", "room_0-proposed", "room_2-proposed"):
        scores = json.loads((results / "scores" / f"{captured}.json").read_text())["results"]
        assert all(math.isfinite(scores[score]) for score in ("psnr", "ssim", "lpips"))
    for room, policies in (("room_0", {"heuristic", "proposed.zip"}), ("room_2", {"proposed.zip"})):
        rows = rows_of(results / "comparison" / room)
        reconstructed = {row[0]: row for row in rows if row[1:3] == [room, "nerfacto"]}
        assert set(reconstructed) == policies
        assert all("–" not in row for row in reconstructed.values())
    assert files_of(data) == before


def same_poses(some, others) -> bool:
    return len(some) == len(others) and all(
        np.array_equal(one.camera_to_world, other.camera_to_world) for one, other in zip(some, others, strict=True)
    )
