import importlib
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import mlflow.projects
import pytest
import yaml

from avp_habitat import command

ROOT = Path(__file__).resolve().parent.parent
PROJECT = yaml.safe_load((ROOT / "MLproject").read_text(encoding="utf-8"))
POINTS = PROJECT["entry_points"]


def commands_of(name):
    """The command lines of an entry point with its defaults, as MLflow puts them together: the last one is the work."""
    point = POINTS[name]
    defaults = {key: value["default"] for key, value in point.get("parameters", {}).items()}
    return [shlex.split(line) for line in point["command"].format(**defaults).split(" && ")]


def test_the_project_has_the_entry_points_that_its_page_shows():
    page = (ROOT / "docs" / "experiment.md").read_text(encoding="utf-8")
    assert set(re.findall(r"mlflow run \. -e (\w+)", page)) == set(POINTS)


def test_it_uses_the_environment_that_is_there():
    assert not {"conda_env", "docker_env", "python_env"} & set(PROJECT)


@pytest.mark.parametrize("name", POINTS)
def test_each_entry_point_is_a_command_that_takes_its_parameters(name):
    assert set(re.findall(r"{(\w+)}", POINTS[name]["command"])) == set(POINTS[name]["parameters"])
    python, flag, module, *words = commands_of(name)[-1]
    assert (python, flag) == ("python", "-m")
    options = next(iter(get_type_hints(importlib.import_module(module).main).values()))
    assert isinstance(command.parse(options, words), options)


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
    words = [sys.executable, "-S", *commands_of(name)[0][1:]]
    answer = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    assert answer.returncode == 1
    assert answer.stderr.strip().endswith("first: source .venv/bin/activate")
    assert len(answer.stderr.strip().splitlines()) == 1
