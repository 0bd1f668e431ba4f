"""Metrics of a user: named, computed and stored beside the suite's own."""

import math

import numpy as np
import pytest

from avp_habitat import collect, command
from avp_habitat.errors import UsageError
from avp_habitat.metrics import FIGURES, Figure, figure_of, figures, find_metrics, measured, metric
from avp_habitat.rollout.format import read_rollout
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import TaskSettings


@metric(Figure("turned_deg", "turned", "°", digits=0, better="lower", meaning="sum of all turns"))
def turned_deg(trajectory):
    return np.degrees(np.abs(np.diff(trajectory.yaw)).sum())


@metric(Figure("far", "far", "%", 100), of="rollout")
def far(rollout):
    return len(rollout.frames) / 100 + len(rollout.heldout) / 1000


@metric(Figure("nothing", "nothing"))
def no_number(trajectory):
    return math.nan


@metric(Figure("coverage", "my coverage"))
def named_as_another(trajectory):
    return 0.0


def undecorated(trajectory):
    return 0.0


HERE = "test_user_metrics"


def test_a_metric_of_an_episode_stands_in_its_info(monkeypatch):
    env = AVPEnv("builtin:0", budget=4, width=16, height=12, metrics=(f"{HERE}:turned_deg", far))
    env.reset(seed=0)
    info = {}
    for action in (1, 1, 2, 1):
        *_, info = env.step(action)
    assert info["avp_episode"]["turned_deg"] == pytest.approx(30.0)
    assert "far" not in info["avp_episode"]


def test_collect_writes_metrics_of_episodes_and_of_rollouts(tmp_path, monkeypatch, capsys):
    words = ["--scene", "builtin:0", "--policy", "spin", "--budget", "3", "--width", "32", "--height", "24"]
    words += ["--out", str(tmp_path / "r"), "--metrics", f"{HERE}:turned_deg", f"{HERE}:far"]
    assert command.run(collect.main, words) == 0
    found = read_rollout(tmp_path / "r").meta["metrics"]
    assert (found["turned_deg"], found["far"]) == (pytest.approx(20.0), 0.03 + 0.02)
    assert "turned_deg" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (f"{HERE}:named_as_another", "there is a figure named 'coverage' already"),
        (f"{HERE}:undecorated", "expected a function decorated by `metric"),
        (f"{HERE}:turned", "has no 'turned'; did you mean 'turned_deg'?"),
        ("no_such_module:turned", "expected a module that can be imported"),
        ("turned", "unknown metric 'turned'"),
    ],
)
def test_a_metric_that_cannot_be_is_refused_in_one_line(name, said):
    with pytest.raises(UsageError, match="metric") as caught:
        TaskSettings(metrics=(name,))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_same_metric_twice_is_refused():
    with pytest.raises(UsageError, match="figure named 'far' already"):
        find_metrics((far, f"{HERE}:far"))


def test_a_metric_that_gives_no_number_is_refused():
    with pytest.raises(UsageError, match="metric 'nothing': expected one finite number, got nan"):
        measured((no_number,), "episode", None)


def test_figures_are_the_suites_and_the_chosen_ones():
    shown = figures((turned_deg,))
    assert [*shown][: len(FIGURES)] == [*FIGURES]
    assert shown["turned_deg"] == turned_deg.figure
    assert figure_of("never_heard_of").heading == "never heard of"
    assert shown["turned_deg"].heading == "turned [°]"
    assert shown["turned_deg"].text(30.4, 2.6) == "30 ± 3"
