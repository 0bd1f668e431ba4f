"""The benchmark's presets: scenes that are the same for everybody, nothing trained in them."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from avp_experiment import compare, configuration
from avp_experiment.cells import COLLECT, RECONSTRUCT, TRAIN, plan
from avp_experiment.configuration import PRESETS, FixedScene
from avp_experiment.folder import open_folder
from avp_habitat import command

V1 = PRESETS["benchmark-v1"]
FIXED = [scene.spec for scene in V1.fixed]


def option(cell, name):
    return cell.words[cell.words.index(name) + 1]


def numbers(cell, name):
    """The numbers that follow an option."""
    found = []
    for word in cell.words[cell.words.index(name) + 1 :]:
        if not word.isdigit():
            break
        found.append(int(word))
    return found


@pytest.fixture(scope="module")
def benchmark():
    return compare.Compare(preset="benchmark-v1", unseen="builtin:7", methods="nbv,proposed_rooms").configuration()


def test_the_presets_scenes_come_first_and_are_those_of_their_digests(benchmark):
    assert [scene.spec for scene in benchmark.scenes] == [*FIXED, "builtin:7"]
    assert {scene.role for scene in benchmark.scenes} == {"unseen"}
    assert [scene.sha256 for scene in benchmark.scenes[:-1]] == [scene.sha256 for scene in V1.fixed]


def test_no_scene_of_the_benchmark_is_ever_trained_in(benchmark, tmp_path):
    cells = plan(benchmark, tmp_path, tracking="avp")
    for cell in (cell for cell in cells if cell.kind == TRAIN):
        rooms = cell.words[cell.words.index("--scene") + 1 : cell.words.index("--reward")]
        assert len(rooms) == V1.rooms
        assert not set(rooms) & {scene.spec for scene in benchmark.scenes}
    assert Counter(cell.kind for cell in cells)[TRAIN] == V1.trainings < V1.seeds


def test_places_of_later_seeds_get_the_policies_of_the_first_in_turn(benchmark, tmp_path):
    cells = [cell for cell in plan(benchmark, tmp_path, tracking="avp") if cell.kind == COLLECT and cell.needs]
    assert {(cell.seed, cell.needs.seed) for cell in cells} == {(seed, seed % 3) for seed in range(6)}
    assert all(option(cell, "--policy") == str(cell.needs.output(tmp_path)) for cell in cells)


def test_each_scene_has_its_budget_and_geometry_after_half_of_it(benchmark, tmp_path):
    cells = [cell for cell in plan(benchmark, tmp_path, tracking="avp") if cell.kind == COLLECT]
    # 61.2 and 54.0 m² of floor.
    budgets = dict.fromkeys([*FIXED, "builtin:7"], 80) | {"builtin-home:100000": 196, "builtin-home:100001": 173}
    for cell in cells:
        budget = budgets[cell.scene.spec]
        assert option(cell, "--budget") == str(budget)
        assert numbers(cell, "--geometry-after") == pytest.approx([budget / 2], abs=0.51)


def test_a_stated_part_is_reconstructed_with_its_own_geometry(benchmark, tmp_path):
    cells = [cell for cell in plan(benchmark, tmp_path, tracking="avp") if cell.kind == RECONSTRUCT]
    assert {(cell.seed, cell.start) for cell in cells} == {(0, 0)}
    assert {(cell.method.name, cell.scene.spec) for cell in cells if cell.frames is None} == {
        (method, scene.spec) for method in ("nbv", "proposed_rooms") for scene in benchmark.scenes
    }
    # Nothing is told of the geometry of the others, and it takes half a minute.
    assert all(option(cell, "--scene") == cell.scene.spec for cell in cells if cell.frames is None)
    assert not any("--scene" in cell.words for cell in cells if cell.frames is not None)


def test_what_was_known_of_presets_is_written_as_before_and_what_is_new_is_added(benchmark, tmp_path):
    open_folder(benchmark, tmp_path / "new")
    kept = json.loads((tmp_path / "new" / "experiment.json").read_text())
    assert kept["geometry_after"] == [40]
    assert {scene["name"]: scene.get("budget") for scene in kept["scenes"]}[FIXED[2]] == 196
    old = compare.Compare(preset="smoke", unseen="none").configuration().as_json()
    assert not {
        "trainings",
        "benchmark",
        "geometry_after",
        "reconstructed",
        "model_geometry",
        "methods",
        "fixed",
    } & set(old)


def test_a_generated_scene_that_came_out_otherwise_is_refused(monkeypatch, capsys):
    other = replace(V1, fixed=(FixedScene("builtin:3", "00ff"),))
    monkeypatch.setitem(configuration.PRESETS, "benchmark-v1", other)
    assert command.run(compare.main, ["--preset", "benchmark-v1"]) == 1
    assert "builtin:3: expected the digest 00ff, which the benchmark is made with, found" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("--seeds", "1"), "seeds: benchmark-v1 has 6, got 1; more starts are welcome"),
        (("--scene", "builtin:0"), "scene: nothing is trained in the scenes of a benchmark; give builtin:0 as unseen"),
        (("--methods", "nbv,proposed"), "methods: nothing is trained in the scenes of benchmark-v1, as proposed would"),
        (("--methods", "pretrained_tuned"), "as pretrained_tuned would be; expected a policy or REWARD_rooms"),
    ],
)
def test_what_would_be_another_benchmark_is_refused(tmp_path, monkeypatch, capsys, words, text):
    monkeypatch.chdir(tmp_path)
    assert command.run(compare.main, ["--preset", "benchmark-v1", *words]) == 2
    assert text in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_benchmark_without_any_scene_is_refused(capsys):
    assert command.run(compare.main, ["--preset", "benchmark-v1-full"]) == 2
    assert "unseen: expected at least one scene, got none" in capsys.readouterr().err


def test_mlflow_projects_leaves_the_scenes_to_the_preset():
    project = yaml.safe_load((Path(__file__).parent.parent / "MLproject").read_text())
    parameters = project["entry_points"]["compare"]["parameters"]
    given = {name: parameters[name]["default"] for name in ("scene", "unseen")}
    assert compare.Compare(preset="benchmark-v1", methods="nbv", **given).configuration().scenes[-1].spec == FIXED[-1]
