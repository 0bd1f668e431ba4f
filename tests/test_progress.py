import sys

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv
from tracking import SmallEnv, mlflow_home, ppo

from avp_habitat import command, metrics, provenance
from avp_sb3 import EvaluationCallback, MetricsCallback, MLflowCallback, RerunCallback


def lines(capsys):
    return capsys.readouterr().err.splitlines()


def test_without_a_terminal_work_tells_its_begin_its_course_and_its_end_in_lines(monkeypatch, capsys):
    monkeypatch.setattr(command, "SECONDS", 0.0)
    for _ in command.progress(range(3), desc="counting", unit="view"):
        pass
    found = lines(capsys)
    assert found[0].startswith("counting: 0 %, 0 of 3 views")
    assert found[-1].startswith("counting: 100 %, 3 of 3 views")
    assert len(found) == len(set(found))


def test_lines_are_seldom(capsys):
    for _ in command.progress(range(1000), desc="counting", unit="view"):
        pass
    assert len(lines(capsys)) == 2


def test_on_a_terminal_it_is_a_bar(monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with command.progress(total=3, desc="counting", unit="view") as bar:
        assert "|" in str(bar)


def test_a_training_tells_its_steps_its_rate_and_its_coverage(monkeypatch, capsys):
    monkeypatch.setattr(command, "SECONDS", 0.0)
    ppo(DummyVecEnv([SmallEnv] * 2)).learn(300, callback=MetricsCallback())
    found = lines(capsys)
    assert found[0].startswith("training: 0 %, 0 of 300 steps")
    # A rollout of two times 64 steps goes beyond the 300 that were asked for.
    assert found[-1].startswith("training: 100 %, 384 of 384 steps")
    assert "step/s" in found[-1]
    assert "coverage " in found[-1]


@pytest.mark.parametrize(("verbose", "models"), [(1, 1), (0, 0)])
def test_a_training_that_prints_itself_or_is_to_be_silent_shows_no_further_progress(capsys, verbose, models):
    ppo(verbose=models).learn(64, callback=MetricsCallback(verbose=verbose))
    assert lines(capsys) == []


def test_the_callbacks_say_once_at_the_end_where_everything_lies(tmp_path, monkeypatch, capsys):
    uri = mlflow_home(tmp_path, monkeypatch)
    tracking, recording = MLflowCallback(), RerunCallback("a b.rrd", pictures=0)
    evaluation = EvaluationCallback(eval_env=DummyVecEnv([SmallEnv]), episodes=1, best_model="best.zip")
    ppo().learn(128, callback=[MetricsCallback(), tracking, recording, evaluation])
    printed = capsys.readouterr().out.splitlines()
    assert [line for line in printed if "best.zip, return " in line]
    assert f"MLflow:   run {tracking.run_id}" in printed
    assert f"compare:  mlflow ui --backend-store-uri {uri}" in printed
    assert "Rerun:    rerun 'a b.rrd'" in printed
    assert len(printed) == 4


def test_callbacks_that_are_to_be_silent_print_nothing(tmp_path, monkeypatch, capsys):
    mlflow_home(tmp_path, monkeypatch)
    evaluation = EvaluationCallback(eval_env=DummyVecEnv([SmallEnv]), episodes=1, best_model="b.zip", verbose=0)
    quiet = [MetricsCallback(verbose=0), MLflowCallback(verbose=0), RerunCallback("a.rrd", pictures=0, verbose=0)]
    ppo().learn(64, callback=[*quiet, evaluation])
    assert capsys.readouterr().out == ""


def test_plain_nerfacto_is_told_to_use_the_cpu_where_there_is_no_gpu(monkeypatch):
    monkeypatch.setattr(provenance, "has_cuda", lambda: False)
    assert provenance.nerfacto_line("'my r'") == (
        "ns-train nerfacto --machine.device-type cpu --pipeline.model.implementation torch --mixed-precision False "
        "avp-data --data 'my r'"
    )
    monkeypatch.setattr(provenance, "has_cuda", lambda: True)
    assert provenance.nerfacto_line("r") == "ns-train nerfacto avp-data --data r"


def test_a_gpu_is_found_where_torch_finds_one():
    torch = pytest.importorskip("torch")
    assert provenance.has_cuda() == torch.cuda.is_available()


def test_terms_are_explained_by_name():
    assert metrics.explained("EI", "ANND").startswith(
        "EI: efficiency index, coverage over the number of pictures; ANND:"
    )
    assert all(np.char.count(text, "\n") == 0 for text in metrics.TERMS.values())
