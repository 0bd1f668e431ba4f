import csv
import json
import os
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import mlflow
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mlflow import MlflowClient
from scipy import stats
from stable_baselines3 import PPO
from tracking import mlflow_home

from avp_habitat import command
from avp_habitat.errors import PolicyError
from avp_habitat.metrics import mean_and_half_width
from avp_habitat.policies.registry import make_policy, steps_of
from avp_habitat.rollout.drawing import draw_trajectory
from avp_habitat.rollout.images import read_rgb
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.rewards import RewardConstants
from avp_habitat.task.settings import TaskSettings
from avp_sb3.evaluate import main
from avp_sb3.evaluation.policy import PolicyResult, evaluate_policy, held_curve
from avp_sb3.evaluation.report import ReportError, read_report, summary, table, write_report

SETTINGS = TaskSettings(budget=6, width=16, height=12)
WORDS = ["--scene", "builtin:0", "--budget", "6", "--width", "16", "--height", "12"]


def evaluate(*words):
    return command.run(main, [*WORDS, *map(str, words)])


def test_the_interval_is_scipys_and_covers_the_mean_as_often_as_it_says():
    rng = np.random.default_rng(0)
    values = rng.normal(3.0, 2.0, size=(7, 4))
    mean, half = mean_and_half_width(values)
    low, high = stats.t.interval(0.95, 6, loc=values.mean(axis=0), scale=stats.sem(values, axis=0))
    np.testing.assert_allclose([mean - half, mean + half], [low, high])
    means, halves = mean_and_half_width(rng.normal(3.0, 2.0, size=(5, 20_000)))
    assert np.mean(np.abs(means - 3.0) < halves) == pytest.approx(0.95, abs=0.01)


def test_one_episode_has_no_interval():
    mean, half = mean_and_half_width(np.array([0.5]))
    assert mean == 0.5
    assert np.isnan(half)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=9), st.integers(0, 5))
def test_a_curve_holds_its_last_value_to_the_budget(values, more):
    budget = len(values) + more
    expected = [values[min(view, len(values)) - 1] for view in range(1, budget + 1)]
    assert held_curve(values, budget).tolist() == expected


@pytest.fixture(scope="module")
def stopping():
    """A task in which the stop action is worth choosing at once."""
    return replace(SETTINGS, constants=replace(RewardConstants(), stop_coverage=0.001))


def test_the_figures_are_those_of_the_episodes_run_by_hand(stopping):
    found = evaluate_policy("random", "builtin:0", episodes=8, seed=40, settings=stopping)
    assert found.seeds.tolist() == list(range(40, 48))
    env = AVPEnv("builtin:0", settings=stopping)
    for row, seed in enumerate(found.seeds):
        policy, coverage, actions = make_policy("random", env, int(seed)), [], []
        observation, ended = env.reset(seed=int(seed))[0], False
        while not ended:
            actions.append(int(policy.predict(observation)[0]))
            observation, _, terminated, truncated, info = env.step(actions[-1])
            coverage.append(info["coverage"])
            ended = terminated or truncated
        views, episode = len(coverage), info["avp_episode"]
        np.testing.assert_array_equal(found.curve[row], coverage + [coverage[-1]] * (6 - views))
        one = {name: values[row] for name, values in found.figures.items()}
        assert one["coverage_area"] == pytest.approx(np.mean(found.curve[row]))
        assert (one["views"], one["stopped"]) == (views, float(terminated))
        assert one["redundant_share"] == episode["redundant_views"] / views
        for name in ("coverage", "annd_m", "ei", "path_length_m", "collisions"):
            assert one[name] == episode[name]
    assert 0 < found.figures["stopped"].mean() < 1


def test_coverage_is_given_after_twenty_views_and_so_on_as_far_as_the_budget_reaches():
    found = evaluate_policy("random", "builtin:0", episodes=1, settings=replace(SETTINGS, budget=45))
    assert {name for name in found.figures if "_at_" in name} == {"coverage_at_20", "coverage_at_40"}
    assert found.figures["coverage_at_40"][0] == found.curve[0, 39]


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.zip"
    ppo = PPO("MlpPolicy", AVPEnv("builtin:0", settings=replace(SETTINGS, observation="map")), n_steps=8, batch_size=8)
    ppo.avp_mlflow_run_id = "f00d"
    ppo.save(path)
    return str(path)


@pytest.mark.parametrize("stochastic", [False, True])
def test_an_episode_depends_on_its_seed_alone(model, stochastic):
    options = {"settings": SETTINGS, "stochastic": stochastic}
    for policy in ("heuristic", model):
        three = evaluate_policy(policy, "builtin:0", episodes=3, seed=7, **options)
        last = evaluate_policy(policy, "builtin:0", episodes=1, seed=9, **options)
        np.testing.assert_array_equal(three.curve[2], last.curve[0])


def test_a_model_gets_the_observation_it_was_trained_on_and_exact_rays(model):
    found = evaluate_policy(model, "builtin:0", episodes=1, settings=replace(SETTINGS, lookup=True))
    exact = evaluate_policy(model, "builtin:0", episodes=1, settings=SETTINGS)
    assert (found.observation, found.training_run) == ("map", "f00d")
    np.testing.assert_array_equal(found.curve, exact.curve)
    with pytest.raises(PolicyError, match=r"model\.zip: trained for the observation_space"):
        evaluate_policy(model, "builtin:0", episodes=1, settings=SETTINGS, observation="numbers")


def result(policy="mine", episodes=3, **changes):
    rng = np.random.default_rng(len(policy))
    figures = {name: rng.random(episodes) for name in ("coverage", "views", "ei", "sofas seen")}
    return PolicyResult(policy, np.arange(5, 5 + episodes), rng.random((episodes, 4)), figures, **changes)


@pytest.mark.parametrize("episodes", [1, 3])
def test_a_report_reads_back_as_it_was_written(tmp_path, episodes):
    written = [result("a", episodes, observation="map"), result("other", episodes, training_run="f00d")]
    write_report(tmp_path / "deep" / "r", written, {"seed": 5})
    for one, other in zip(written, read_report(tmp_path / "deep" / "r"), strict=True):
        assert (one.policy, one.observation, one.training_run) == (other.policy, other.observation, other.training_run)
        np.testing.assert_array_equal(one.seeds, other.seeds)
        np.testing.assert_array_equal(one.curve, other.curve)
        assert one.figures.keys() == other.figures.keys()
        for name, values in one.figures.items():
            np.testing.assert_array_equal(values, other.figures[name])
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["r"]


def test_a_figure_that_some_policies_lack_is_left_open_for_them(tmp_path):
    mine, other = result(), result("other")
    mine.figures["surface"] = np.array([0.1, 0.2, 0.3])
    for pair in ([mine, other], [other, mine]):
        row = next(row for row in table(pair).splitlines() if row.startswith("| surface"))
        assert [cell.strip() for cell in row.strip("|").split("|")][1 + pair.index(other)] == "–"
    written = write_report(tmp_path / "e", [other, mine], {})
    rows = list(csv.DictReader((written / "episodes.csv").open()))
    assert [row["surface"] for row in rows] == ["", "", "", "0.1", "0.2", "0.3"]
    assert read_report(written)[0].figures.keys() == other.figures.keys()


def test_a_damaged_report_is_named(tmp_path):
    folder = write_report(tmp_path / "r", [result()], {})
    path = folder / "evaluation.json"
    whole = json.loads(path.read_text())
    path.write_text(json.dumps(whole | {"format_version": 9}))
    with pytest.raises(ReportError, match=r"evaluation\.json: expected avp-evaluation version 1, found .* version 9"):
        read_report(folder)
    path.write_text("[]")
    with pytest.raises(ReportError, match=r"evaluation\.json: expected a report"):
        read_report(folder)


def test_the_table_shows_means_with_their_intervals_in_percent():
    mine = result()
    mean, half = mean_and_half_width(100 * mine.figures["coverage"])
    rows = [
        [cell.strip() for cell in row.strip("|").split("|")] for row in table([mine, result("one", 1)]).splitlines()
    ]
    assert rows[0] == ["figure", "mine", "one"]
    coverage = next(row for row in rows if row[0] == "coverage [%]")
    assert coverage[1] == f"{mean:.1f} ± {half:.1f}"
    assert re.fullmatch(r"\d+\.\d", coverage[2])
    assert "sofas seen" in {row[0] for row in rows}, "a figure that the suite does not list"
    assert rows[-1] == ["episodes", "3", "1"]
    assert rows[-2][:2] == [
        "CpV [%/view]",
        f"{100 * mine.figures['coverage'].mean() / mine.figures['views'].mean():.2f}",
    ]
    assert summary(result("one", 1))["ei"]["half_width"] is None


def test_the_command_compares_writes_and_logs(tmp_path, monkeypatch, capsys, model):
    mlflow_home(tmp_path, monkeypatch)
    words = ["--policy", "heuristic", "--policy", model, "--policy", "heuristic", "--episodes", "2", "--out", "report"]
    monkeypatch.setattr("sys.argv", ["evaluate.py", *WORDS, *words])
    assert command.run(main) == 0
    printed = capsys.readouterr().out
    report = json.loads((tmp_path / "report" / "evaluation.json").read_text())
    assert report["command"].startswith("python -m avp_sb3.evaluate --scene builtin:0")
    assert report.keys() >= {"commit", "machine", "versions", "seed", "scene", "settings", "complete"}
    assert [policy["policy"] for policy in report["policies"]] == ["heuristic", model]
    assert {tuple(e["seed"] for e in policy["episodes"]) for policy in report["policies"]} == {(1000, 1001)}
    with (tmp_path / "report" / "episodes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["policy"], row["seed"]) for row in rows[1:3]] == [("heuristic", "1001"), (model, "1000")]
    assert (tmp_path / "report" / "coverage.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "report" / "table.md").read_text().strip() in printed

    client = MlflowClient()
    experiment = client.get_experiment_by_name("avp").experiment_id
    parent = re.search(r"run (\w+) in experiment", printed)[1]
    assert {item.path for item in client.list_artifacts(parent)} >= {"evaluation.json", "coverage.png"}
    assert client.get_run(parent).data.metrics == {}
    table = mlflow.artifacts.load_dict(f"runs:/{parent}/policies.json")
    rows = [dict(zip(table["columns"], row, strict=True)) for row in table["data"]]
    assert [(row["policy"], row["episodes"]) for row in rows] == [("heuristic", "2"), ("model.zip", "2")]
    for row, policy in zip(rows, report["policies"], strict=True):
        views = np.mean([episode["views"] for episode in policy["episodes"]])
        coverage = np.mean([episode["coverage"] for episode in policy["episodes"]])
        assert row["CpV [%/view]"] == f"{100 * coverage / views:.2f}"
        assert row["coverage [%]"].startswith(f"{100 * coverage:.1f} ± ")
    runs = client.search_runs([experiment], f"tags.`mlflow.parentRunId` = '{parent}'")
    assert {run.data.params["policy"] for run in runs} == {"heuristic", model}
    learned = next(run for run in runs if run.data.params["policy"] == model)
    assert learned.data.tags["avp.policy_run"] == "f00d"
    assert learned.info.run_name == learned.data.tags["avp.policy"] == "model.zip"
    assert learned.data.tags["avp.scene"] == "builtin:0"
    entry = report["policies"][1]
    assert learned.data.metrics["eval/coverage"] == pytest.approx(entry["summary"]["coverage"]["mean"])
    curve = client.get_metric_history(learned.info.run_id, "eval/curve")
    assert [(point.step, point.value) for point in curve] == list(enumerate(entry["curve"]["mean"], start=1))
    figures = {name: values["mean"] for name, values in entry["summary"].items()}
    assert learned.data.metrics["eval/cpv"] == pytest.approx(100 * figures["coverage"] / figures["views"])
    drawn = logged_picture(client, learned.info.run_id, tmp_path / "drawn")
    env = AVPEnv("builtin:0", settings=replace(SETTINGS, observation="map"))
    steps = list(steps_of(env, PPO.load(model), seed=1000))
    np.testing.assert_array_equal(drawn, draw_trajectory(env.area, steps[-1].info["avp_trajectory"]))
    assert logged_picture(client, parent, tmp_path / "plot").shape == read_rgb(tmp_path / "report/coverage.png").shape


def logged_picture(client, run, folder):
    """The picture that MLflow's page shows; next to it lies a compressed one."""
    folder.mkdir()
    (path,) = (file.path for file in client.list_artifacts(run, "images") if file.path.endswith(".png"))
    return read_rgb(Path(client.download_artifacts(run, path, folder)))


def test_two_models_of_one_file_name_stay_apart(tmp_path, monkeypatch, capsys, model):
    mlflow_home(tmp_path, monkeypatch)
    paths = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        paths.append(shutil.copy(model, f"{name}/model.zip"))
    assert evaluate("--policy", paths[0], "--policy", paths[1], "--episodes", 1) == 0
    client = MlflowClient()
    found = client.search_runs([client.get_experiment_by_name("avp").experiment_id], "tags.`avp.policy` != ''")
    assert {run.data.tags["avp.policy"] for run in found} == set(paths)


def test_a_store_that_does_not_answer_leaves_the_report(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mlflow, "get_tracking_uri", lambda: "http://me:secret@127.0.0.1:9")
    monkeypatch.setattr(mlflow, "is_tracking_uri_set", lambda: True)
    assert evaluate("--policy", "spin", "--episodes", 1, "--out", "kept") == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: the report is in kept, but MLflow did not take it: MLflow at http://127.0.0.1:9 ")
    assert "secret" not in error
    assert read_report(tmp_path / "kept")[0].policy == "spin"


@pytest.mark.parametrize(
    ("words", "code", "error"),
    [
        (["--policy", "heuristc"], 2, "unknown policy 'heuristc': .*did you mean 'heuristic'"),
        (["--policy", "random", "--policy", "gone.zip"], 2, r"gone\.zip: no such model file"),
        (["--policy", "random", "--observation", "maps"], 2, "unknown observation 'maps': .*did you mean 'map'"),
        (["--policy", "random", "--reward", "propose"], 2, "unknown reward 'propose'"),
        (
            ["--policy", "random", "--episodes", "0"],
            2,
            "--episodes: expected .* from 1 to 1,000,000, got 0",
        ),
        (["--policy", "random", "--seed", "-1"], 2, "--seed: expected a whole number from 0 to .*, got -1"),
        (["--policy", "random", "--out", "."], 2, "--out .: exists already"),
        (["--policy", "random", "--out", "/proc/no/r"], 1, "--out /proc/no/r: cannot write there: /proc"),
        (["--policy", "random", "--out", "/dev/null/r"], 1, "--out /dev/null/r: cannot write there: /dev/null"),
        (["--policy", "random", "--scene", "gone.glb"], 1, r"gone\.glb: no such scene file"),
    ],
)
def test_wrong_input_is_one_line_before_any_episode(tmp_path, monkeypatch, capsys, words, code, error):
    monkeypatch.chdir(tmp_path)
    assert evaluate(*words) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert re.search(error, lines[0])
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_evaluation_keeps_its_episodes(tmp_path, monkeypatch, capsys):
    def interrupt(bar, n=1):
        bar.n += n
        if bar.n == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("avp_habitat.command.tqdm.update", interrupt)
    words = ["--policy", "random", "--policy", "heuristic", "--policy", "spin", "--no-mlflow", "--episodes", "2"]
    assert evaluate(*words, "--out", tmp_path / "kept") == 130
    assert "interrupted after 3 episodes, which are kept" in capsys.readouterr().out
    assert [(found.policy, len(found.seeds)) for found in read_report(tmp_path / "kept")] == [
        ("random", 2),
        ("heuristic", 1),
    ]
    assert json.loads((tmp_path / "kept" / "evaluation.json").read_text())["complete"] is False
