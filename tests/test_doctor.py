"""The doctor: one line for each thing, with the fix where it is broken."""

import json
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

from avp_habitat import command
from avp_habitat.doctor import ABSENT, BROKEN, OK, Finding, Plug, ask, check_host, check_python, read_manifest
from avp_habitat.doctor import __main__ as doctor

ROOT = Path(__file__).resolve().parent.parent
PLUGINS = tomllib.loads((ROOT / "plugins.toml").read_text(encoding="utf-8"))["plugin"]
SCRIPTS = sysconfig.get_path("scripts")


def run(*arguments, **environment):
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def with_packages(folder, **versions):
    """Puts metadata of other versions before those of the environment; returns the environment variables."""
    for name, version in versions.items():
        info = folder / f"{name}-{version}.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    return {"PYTHONPATH": os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH")]))}


@pytest.fixture(scope="module")
def report():
    """Of the whole doctor, run once."""
    done = run("-m", "avp_habitat.doctor", "--json", PATH=f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}")
    said = json.loads(done.stdout)
    assert done.returncode == (0 if said["ok"] else 1), done.stderr
    return said


def test_every_plug_of_the_manifest_has_a_line_and_is_seen_by_its_host(report):
    seen = {finding["subject"]: finding for finding in report["findings"]}
    for plug in PLUGINS:
        finding = seen[f"plug {plug['name']}"]
        assert finding["mark"] == OK, finding
        assert plug["host"] in finding["text"]


def test_the_whole_suite_is_found_healthy_here(report):
    assert report["ok"]
    assert not [finding for finding in report["findings"] if finding["mark"] == BROKEN]
    marks = {finding["subject"]: finding["mark"] for finding in report["findings"]}
    assert (marks["Python"], marks["numpy"], marks["simulator raycast"]) == (OK, OK, OK)
    assert {"simulator habitat", "graphics (EGL)", "CUDA for torch", "LPIPS weights"} <= set(marks)


def test_a_version_out_of_range_is_a_line_with_the_fix(tmp_path):
    code = (
        "from avp_habitat.doctor import check_packages\n"
        "for finding in check_packages(): print(finding.line(colour=False))"
    )
    done = run("-c", code, **with_packages(tmp_path, pygltflib="0.9"))
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("!!")]
    assert re.match(r'!!  pygltflib +0\.9, but the suite needs >=1\.16; pip install "pygltflib>=1\.16"$', line)


def test_something_broken_is_an_exit_code_of_1_and_a_line_on_standard_error(monkeypatch, capsys):
    found = [
        Finding(OK, "first", "fine"),
        Finding(BROKEN, "second", "worn out; mend it"),
        Finding(ABSENT, "third", "-"),
    ]
    checks = {finding.subject: lambda finding=finding: [finding] for finding in found}
    monkeypatch.setattr(doctor, "all_checks", lambda: checks)
    assert command.run(doctor.main, []) == 1
    said, complaint = capsys.readouterr()
    assert [line.split()[:2] for line in said.splitlines()] == [["ok", "first"], ["!!", "second"], ["--", "third"]]
    assert complaint.strip() == "error: broken: second; what to do stands in the lines marked !!"
    assert command.run(doctor.main, ["--json"]) == 1
    assert json.loads(capsys.readouterr().out)["findings"][1] == {
        "mark": "!!",
        "subject": "second",
        "text": "worn out; mend it",
    }


def test_an_unknown_option_is_a_mistake_of_usage():
    assert run("-m", "avp_habitat.doctor", "--all").returncode == 2


def test_colours_only_when_asked_for():
    finding = Finding(BROKEN, "numpy", "two\nlines")
    assert finding.line(colour=False).split(maxsplit=2) == ["!!", "numpy", "two lines"]
    assert finding.line(colour=True).startswith("\033[")


@pytest.fixture
def bare(tmp_path):
    """Runs a program in an environment of the suite's own metadata alone."""
    info = next(found for entry in sys.path for found in Path(entry).glob("avp_suite-*.dist-info"))
    (tmp_path / info.name).symlink_to(info)
    (tmp_path / "packaging").symlink_to(Path(sysconfig.get_path("purelib")) / "packaging")
    # What `import avp_habitat` asks of gymnasium.
    (tmp_path / "gymnasium.py").write_text("registry = {'AVP-v0': None}\n")

    def lines(code):
        return run("-S", "-c", code, PYTHONPATH=f"{tmp_path}{os.pathsep}{ROOT}").stdout.splitlines()

    return lines


def test_what_is_missing_of_an_extra_is_one_line_with_the_extra(bare):
    lines = bare(
        "from avp_habitat.doctor import check_packages\n"
        "for finding in check_packages(): print(finding.line(colour=False))"
    )
    assert any(
        re.match(r'!!  numpy +not installed, and the suite needs it; pip install "numpy', line) for line in lines
    )
    (extra,) = [line for line in lines if line.startswith("--  extra sb3")]
    assert "mlflow" in extra
    assert extra.endswith("pip install 'avp-suite[sb3]'")


def test_a_host_that_is_not_installed_is_optional_and_says_how_to_get_it(bare):
    (line,) = bare(
        "from avp_habitat.doctor import Plug, check_host\n"
        "plug = Plug('nerfstudio', 'nerfstudio.dataparser_configs', 'avp-data', 'a:b', 'true')\n"
        "print(check_host('nerfstudio', [plug])[0].line(colour=False))"
    )
    assert re.match(r"--  plug avp-data +nerfstudio is not installed; pip install 'avp-suite\[nerfstudio\]'", line)


@pytest.mark.parametrize(
    ("program", "expected"),
    [
        ("import os; os.abort()", "crashed with SIGABRT"),
        ("import time; time.sleep(60)", "gave no answer within 2 s"),
        ("print('hello')", "said 'hello' instead of JSON"),
        ("raise OSError('no such\\nthing')", "thing"),
        ("import os; os._exit(7)", "ended with exit code 7"),
    ],
)
def test_a_program_that_does_not_answer_becomes_a_line(program, expected):
    assert ask(["-c", program], time_limit_s=2.0) == (None, expected)


def test_only_the_last_line_of_an_answer_counts():
    program = "import sys; print('noise'); print(sys.argv[1])"
    assert ask(["-c", program, '{"a": [1]}'], time_limit_s=30.0) == ({"a": [1]}, None)


def plug(host, group, name, obj):
    return Plug(host, group, name, obj, "true")


def test_a_plug_that_its_host_does_not_see_is_broken_and_says_why():
    here = plug("gymnasium", "registration on import", "AVP-v0", "avp_habitat.task.env:AVPEnv")
    away = plug("gymnasium", "registration on import", "AVP-v9", "avp_habitat.task.env:AVPEnv")
    wrapper = plug("gymnasium", "wrapper", "Settings", "avp_habitat.task.settings:TaskSettings")
    marks = check_host("gymnasium", [here, away, wrapper])
    assert [finding.mark for finding in marks] == [OK, BROKEN, BROKEN]
    assert "does not see it (VersionNotFound" in marks[1].text
    assert "avp_habitat.task.settings:TaskSettings is no wrapper" in marks[2].text


def test_an_entry_point_that_the_installed_suite_does_not_have_is_broken():
    pytest.importorskip("mlflow")
    stale = plug("mlflow", "mlflow.run_context_provider", "avp", "avp_habitat.tracking.context:Moved")
    (finding,) = check_host("mlflow", [stale])
    assert finding.mark == BROKEN
    assert "no such entry point (mlflow.run_context_provider); pip install -e ." in finding.text


@pytest.fixture
def importer(monkeypatch, tmp_path):
    """Finding about rerun's importer with a PATH, which may hold a program of that name with an exit code."""
    pytest.importorskip("rerun")
    (entry,) = [plug for plug in read_manifest() if plug.name == "rerun-importer-avp"]

    def look(path, exit_code=None):
        if exit_code is not None:
            program = tmp_path / entry.name
            program.write_text(f"#!/bin/sh\nexit {exit_code}\n")
            program.chmod(0o755)
        monkeypatch.setenv("PATH", str(path))
        (finding,) = check_host("rerun", [entry])
        return finding

    return look


def test_the_importer_is_run_and_has_to_leave_other_paths_alone(importer, tmp_path):
    assert importer(SCRIPTS).mark == OK
    greedy = importer(tmp_path, exit_code=0)
    assert greedy.mark == BROKEN
    assert "exit code 0 on a path that is not its own, not 66" in greedy.text


def test_an_importer_that_is_not_on_the_path_says_what_to_export(importer, tmp_path):
    finding = importer(tmp_path)
    assert finding.mark == ABSENT
    assert f'export PATH="{SCRIPTS}:$PATH"' in finding.text


def test_the_weights_of_lpips_are_looked_for_where_torch_keeps_them(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert doctor.check_lpips()[0].mark == ABSENT
    assert str(tmp_path / "hub" / "checkpoints") in doctor.check_lpips()[0].text
    path = tmp_path / "hub" / "checkpoints" / doctor.LPIPS_WEIGHTS
    path.parent.mkdir(parents=True)
    path.touch()
    assert doctor.check_lpips() == [Finding(OK, "LPIPS weights", str(path))]


def test_the_path_of_the_weights_is_the_one_that_reconstructions_use(monkeypatch, tmp_path):
    pytest.importorskip("torch")
    from avp_nerfstudio.method.scores import lpips_weights_path

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    path = lpips_weights_path()
    path.parent.mkdir(parents=True)
    path.touch()
    assert doctor.check_lpips()[0].text == str(path)


def test_the_python_of_this_environment_is_in_the_range_of_the_suite():
    assert [finding.mark for finding in check_python()] == [OK, OK]


def test_a_wheel_brings_the_manifest_to_where_the_doctor_looks(tmp_path):
    pytest.importorskip("setuptools")
    build = "import sys; from setuptools import build_meta; print(build_meta.build_wheel(sys.argv[1]))"
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "plugins.toml", "README.md", "LICENSE", "avp_habitat", "avp_sb3", "avp_nerfstudio"):
        (source / name).symlink_to(ROOT / name)
    done = subprocess.run(
        [sys.executable, "-c", build, str(tmp_path)], cwd=source, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (wheel,) = tmp_path.glob("*.whl")
    site = tmp_path / "env" / "lib" / "python" / "site-packages"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    (data,) = site.glob("*.data/data")
    (data / "share").rename(tmp_path / "env" / "share")
    code = "from avp_habitat import doctor as m; print(m.manifest_path(), len(m.read_manifest()))"
    path = os.pathsep.join(filter(None, [str(site), os.environ.get("PYTHONPATH")]))
    installed = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    expected = tmp_path / "env" / "share" / "avp-suite" / "plugins.toml"
    assert installed.stdout.split() == [str(expected), str(len(PLUGINS))], installed.stderr


@pytest.mark.habitat
def test_habitat_sim_is_really_opened_where_it_is_installed():
    (finding,) = doctor.check_simulator("habitat")
    assert finding.mark == OK, finding
    assert re.search(r"habitat-sim 0\.\d\.\d: opened builtin:0 and rendered in", finding.text)
