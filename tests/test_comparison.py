import json
import math
import re
from pathlib import Path

import mlflow
import numpy as np
import pytest
from mlflow import MlflowClient
from mlflow.entities import Metric
from PIL import Image
from scipy import stats
from tracking import mlflow_home

from avp_habitat import command
from avp_habitat.tracking.compare import compare, main, markdown
from avp_habitat.tracking.compare import rows as rows_of
from avp_habitat.tracking.names import NOTE_TAG, PAGE_TAG, VIEW_TAG, VIEWS_TAG
from avp_habitat.tracking.view import VIEWS, prepare_experiment, run_colour


@pytest.fixture
def store(tmp_path, monkeypatch):
    return MlflowClient(mlflow_home(tmp_path, monkeypatch))


def make_run(client, experiment, metrics, **tags):
    tags = {f"avp.{name}": value for name, value in tags.items()}
    run = client.create_run(experiment, tags=tags).info.run_id
    client.log_batch(run, [Metric(f"eval/{name}", value, 0, 0) for name, value in metrics.items()])
    client.set_terminated(run)
    return run


@pytest.fixture
def experiment(store):
    """Two reconstructions by one policy, one by another, an evaluation, a training that was evaluated in between."""
    found = store.create_experiment("avp")
    room = {"scene": "room.glb"}
    nerf = {**room, "method": "avp-nerfacto"}
    make_run(store, found, {"coverage": 0.9, "views": 40, "psnr": 24.0, "ssim": 0.8, "lpips": 0.3}, policy="a", **nerf)
    make_run(store, found, {"coverage": 0.8, "views": 60, "psnr": 25.0, "ssim": 0.9, "lpips": 0.2}, policy="a", **nerf)
    make_run(store, found, {"coverage": 0.2, "views": 80, "psnr": 18.0, "ssim": math.nan}, policy="b", **nerf)
    make_run(store, found, {"coverage": 0.5, "coverage_ci95": 0.01, "views": 80}, policy="b", **room)
    make_run(store, found, {"coverage": 0.7, "views": 70}, **room)
    make_run(store, found, {"coverage": 0.6, "views": 50, "psnr": 20.0}, policy="a", scene="other.glb", method="nerf")
    return found


def run_command(*words):
    return command.run(main, [str(word) for word in words])


def parsed(table):
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.strip().splitlines()]
    assert rows[0][:4] == ["policy", "scene", "method", "runs"]
    return [dict(zip(rows[0], row, strict=True)) for row in rows[2:]]


def test_the_table_holds_means_and_students_intervals_by_scene_policy_and_method(store, experiment):
    rows = parsed(markdown(compare(store, experiment)))
    assert [(row["scene"], row["policy"], row["method"], row["runs"]) for row in rows] == [
        ("other.glb", "a", "nerf", "1"),
        ("room.glb", "a", "avp-nerfacto", "2"),
        ("room.glb", "b", "avp-nerfacto", "1"),
        ("room.glb", "b", "evaluation", "1"),
    ]
    half = stats.t.ppf(0.975, 1) * stats.sem([24.0, 25.0])
    assert rows[1]["PSNR [dB]"] == f"24.50 ± {half:.2f}"
    assert rows[1]["CpV [%/view]"] == f"{100 * 0.85 / 50:.2f}"
    assert (rows[2]["PSNR [dB]"], rows[2]["SSIM"], rows[2]["LPIPS"]) == ("18.00", "–", "–")
    assert (rows[3]["coverage [%]"], rows[3]["PSNR [dB]"]) == ("50.0 ± 1.0", "–")


def test_a_rollout_counts_once_beside_its_reconstruction(store):
    found, room = store.create_experiment("avp"), {"scene": "room.glb", "policy": "a"}
    figures = {"coverage": 0.9, "views": 40, "visibility": 0.625, "visibility_parallax": 0.5}
    rollout = make_run(store, found, figures, kind="rollout", **room)
    make_run(store, found, {**figures, "psnr": 24.0}, kind="reconstruction", method="nerf", rollout_run=rollout, **room)
    make_run(store, found, {"coverage": 0.4, "views": 20}, kind="rollout", **room)
    rows = parsed(markdown(compare(store, found)))
    assert [(row["method"], row["runs"], row["views"], row["visibility [%]"], row["parallax [%]"]) for row in rows] == [
        ("nerf", "1", "40.0", "62.5", "50.0"),
        ("rollout", "1", "20.0", "–", "–"),
    ]


def test_the_best_reconstruction_of_a_scene_comes_first(store):
    found = store.create_experiment("avp")
    make_run(store, found, {"coverage": 0.99, "views": 9}, policy="none", scene="room")
    make_run(store, found, {"coverage": 0.9, "views": 9, "psnr": 10.0}, policy="poor", scene="room")
    make_run(store, found, {"coverage": 0.1, "views": 9, "psnr": 30.0}, policy="good", scene="room")
    assert [method.policy for method in compare(store, found)] == ["good", "poor", "none"]


def test_the_command_keeps_one_run_and_renews_it(store, experiment, tmp_path, capsys):
    assert run_command("--out", tmp_path / "deep" / "out") == 0
    printed = capsys.readouterr().out
    first = re.search(r"run (\w+) in experiment 'avp'", printed)[1]
    assert len(parsed(printed.partition("\n\n")[0])) == 4
    assert {path.name for path in (tmp_path / "deep" / "out").iterdir()} == {"comparison.md", "comparison.png"}
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["out"]
    make_run(store, experiment, {"coverage": 1.0, "views": 30, "psnr": 30.0}, policy="c", scene="room.glb", method="m")
    assert run_command() == 0
    assert f"run {first} in experiment" in capsys.readouterr().out
    run = store.get_run(first)
    assert run.data.metrics == {}
    assert run.info.status == "FINISHED"
    assert run.data.tags["avp.scene"] == "other.glb, room.glb"
    assert json.loads(run.data.tags["mlflow.loggedArtifacts"]) == [{"path": "comparison.json", "type": "table"}]
    table = mlflow.artifacts.load_dict(f"runs:/{first}/comparison.json")
    head, rows = rows_of(compare(store, experiment))
    assert table == {"columns": head, "data": rows}
    assert len(rows) == 5
    assert "| c " in run.data.tags["mlflow.note.content"]


def test_each_set_of_scenes_has_a_run_of_its_own(store, experiment):
    for scenes in ((), ("--scene", "room.glb"), ("--scene", "room.glb", "--scene", "other.glb")):
        assert run_command(*scenes) == 0
    found = store.search_runs([experiment], "tags.`avp.kind` = 'comparison'")
    assert sorted(run.data.tags["avp.scene"] for run in found) == ["other.glb, room.glb", "room.glb"]


def test_the_picture_shows_the_policies_that_have_a_reconstruction_in_their_colours(store, experiment, tmp_path):
    make_run(store, experiment, {"coverage": 0.5, "views": 80}, policy="greedy", scene="room.glb")
    assert run_command("--out", tmp_path / "out") == 0
    picture = np.asarray(Image.open(tmp_path / "out" / "comparison.png").convert("RGB"))
    drawn = {"#{:02x}{:02x}{:02x}".format(*colour) for colour in np.unique(picture.reshape(-1, 3), axis=0)}
    assert len({run_colour(policy) for policy in ("a", "b", "greedy")}) == 3
    assert {run_colour("a"), run_colour("b")} <= drawn
    assert run_colour("greedy") not in drawn


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (["--experiment", "apv"], 2, "unknown experiment 'apv': expected one of .*did you mean 'avp'"),
        (["--scene", "rom.glb"], 2, r"--scene: unknown scene 'rom\.glb': .*did you mean 'room\.glb'"),
        (["--mlflow", "off"], 2, "--mlflow: expected an address or auto, got off"),
        (["--mlflow", "http://127.0.0.1:9"], 1, "MLflow at http://127.0.0.1:9 cannot be used"),
        (["--mlflow", "mango://here"], 1, "MLflow at mango://here cannot be used"),
        (["--mlflow", "sqlite:///mlfow.db"], 1, "MLflow at sqlite:///mlfow.db cannot be used: .*No such file"),
        (["--out", "."], 2, "--out .: exists already"),
        (["--out", "mlflow.db/out"], 2, "--out mlflow.db/out: cannot write there"),
    ],
)
def test_wrong_input_is_one_line(experiment, capsys, words, code, error):
    assert run_command(*words) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert re.search(error, lines[0])
    assert not Path("mlfow.db").exists()


def test_an_experiment_without_figures_says_what_makes_them(store, capsys):
    make_run(store, store.create_experiment("avp"), {"psnr": 1.0})
    assert run_command() == 1
    assert re.search(r"no run with eval/coverage.*avp_sb3\.evaluate.*avp_nerfstudio\.log", capsys.readouterr().err)


def test_an_experiments_page_is_prepared_once_and_then_left_to_people(store):
    experiment = store.create_experiment("mine", tags={NOTE_TAG: "my words"})
    prepare_experiment(store, experiment)
    tags = store.get_experiment(experiment).tags
    assert {VIEW_TAG + view.key for view in VIEWS} <= tags.keys()
    assert (tags[NOTE_TAG], tags[PAGE_TAG]) == ("my words", "custom_model_development")
    store.delete_experiment_tag(experiment, VIEW_TAG + VIEWS[2].key)
    store.set_experiment_tag(experiment, VIEW_TAG + VIEWS[0].key, "changed")
    prepare_experiment(store, experiment)
    tags = store.get_experiment(experiment).tags
    assert VIEW_TAG + VIEWS[2].key not in tags
    assert tags[VIEW_TAG + VIEWS[0].key] == "changed"


def test_a_cut_connection_is_made_good_by_the_next_preparation(store, monkeypatch, caplog):
    experiment = store.create_experiment("cut")
    set_tag, left = store.set_experiment_tag, [2]

    def cut(*arguments):
        left[0] -= 1
        if left[0] < 0:
            raise OSError("the line is dead")
        set_tag(*arguments)

    monkeypatch.setattr(store, "set_experiment_tag", cut)
    prepare_experiment(store, experiment)
    assert "its page could not be prepared: the line is dead" in caplog.text
    assert VIEWS_TAG not in store.get_experiment(experiment).tags
    monkeypatch.undo()
    prepare_experiment(store, experiment)
    assert {VIEW_TAG + view.key for view in VIEWS} | {NOTE_TAG, VIEWS_TAG} <= store.get_experiment(
        experiment
    ).tags.keys()


def test_a_missing_experiment_costs_a_warning(store, caplog):
    prepare_experiment(store, "77")
    assert "MLflow experiment 77: its page could not be prepared" in caplog.text
