import importlib
import re
import runpy
import shlex
import subprocess
import sys
from dataclasses import is_dataclass
from pathlib import Path
from typing import get_type_hints

import mlflow.projects
import pytest
import yaml

from avp_habitat import command

ROOT = Path(__file__).resolve().parent.parent
PROJECT = yaml.safe_load((ROOT / "MLproject").read_text(encoding="utf-8"))
POINTS = PROJECT["entry_points"]


def words_of(name):
    """The command line of an entry point with its defaults, as MLflow puts it together."""
    point = POINTS[name]
    defaults = {key: value["default"] for key, value in point.get("parameters", {}).items()}
    return shlex.split(point["command"].format(**defaults))


def options_of(words):
    """What the command's own parser makes of a command line."""
    assert words[:2] == ["python", "-m"]
    name, *rest = words[3:] if words[2] == "avp_experiment.part" else words[2:]
    if name.endswith(".py"):
        return runpy.run_path(str(ROOT / name))["_parser"]().parse_args(rest)
    program = importlib.import_module(name)
    kind = next(iter(get_type_hints(program.main).values()))
    return command.parse(kind, rest) if is_dataclass(kind) else program._parser().parse_args(rest)


def test_the_project_has_the_entry_points_that_its_page_shows():
    page = (ROOT / "docs" / "experiment.md").read_text(encoding="utf-8")
    assert set(re.findall(r"mlflow run \. -e (\w+)", page)) == set(POINTS)


def test_it_uses_the_environment_that_is_there():
    assert not {"conda_env", "docker_env", "python_env"} & set(PROJECT)


@pytest.mark.parametrize("name", POINTS)
def test_each_entry_point_is_a_command_that_takes_its_parameters(name):
    options = vars(options_of(words_of(name)))
    for parameter in POINTS[name]["parameters"]:
        assert parameter in options or parameter in {"reconstruction"}, parameter


@pytest.mark.parametrize("name", POINTS)
def test_the_page_names_parameters_that_exist(name):
    page = (ROOT / "docs" / "experiment.md").read_text(encoding="utf-8")
    for line in re.findall(rf"mlflow run \. -e {name} (.*)", page):
        assert set(re.findall(r"-P (\w+)=", line)) <= set(POINTS[name]["parameters"])


def test_a_user_mistake_ends_mlflow_run_with_the_commands_one_line(tmp_path, monkeypatch, capfd):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path}/mlflow.db")
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=":")
    with pytest.raises(mlflow.exceptions.ExecutionException):
        mlflow.projects.run(str(ROOT), "compare", parameters={"preset": "cpuu", "out": str(tmp_path / "e")},
                            env_manager="local")  # fmt: skip
    errors = capfd.readouterr().err
    assert "error: unknown preset 'cpuu'" in errors
    assert "did you mean 'cpu'?" in errors
    assert not (tmp_path / "e").exists()


@pytest.mark.parametrize("name", POINTS)
def test_a_python_without_the_packages_is_told_in_one_line(name):
    # -S leaves site-packages out, as the `python` of a path without the environment does.
    words = [sys.executable, "-S", *words_of(name)[1:]]
    answer = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert answer.returncode == 1
    assert answer.stderr.strip().endswith("first: source .venv/bin/activate")
    assert len(answer.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize("name", [name for name in POINTS if name != "compare"])
def test_a_part_takes_its_words_and_answers_as_it_does_alone(name):
    target = words_of(name)[3]
    lines = (["-m", "avp_experiment.part", target], [target] if target.endswith(".py") else ["-m", target])
    through, alone = (
        subprocess.run([sys.executable, *line, "--no-such"], cwd=ROOT, capture_output=True, text=True) for line in lines
    )
    assert through.returncode == alone.returncode == 2
    assert through.stderr == alone.stderr
    assert "error: " in alone.stderr
