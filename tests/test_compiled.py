"""Compiled kernels where neither the package nor the home can be written, as in containers."""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from no_rights import without_root_rights

ROOT = Path(__file__).resolve().parent.parent
KERNEL = "import json; from avp_habitat.task.floor_map import draw; "
RUN = "print(json.dumps(draw.stats.cache_path))"


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A copy of the package in which nothing can be written."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copytree(ROOT / "avp_habitat", folder / "avp_habitat", ignore=shutil.ignore_patterns("__pycache__"))
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)
    yield folder
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o755)


@pytest.fixture
def run(installed, tmp_path):
    """Runs Python from that copy without a home; its output and its complaints, line by line."""

    def ran(code, *, words=("-c",), **more):
        env = {name: value for name, value in os.environ.items() if name not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
        env |= {"PYTHONPATH": str(installed), "HOME": "/proc/nonexistent", "TMPDIR": str(tmp_path), **more}
        command = [*without_root_rights(), sys.executable, *words, code]
        done = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines(), done.stderr.splitlines()

    return ran


def test_a_read_only_install_without_a_home_compiles_and_keeps_the_code_among_temporary_files(run, tmp_path):
    (path,), (told,) = run(KERNEL + RUN)
    folder = tmp_path / f"avp-numba-{os.getuid()}"
    assert json.loads(path).startswith(str(folder))
    assert told == f"compiled code is kept in {folder}; name a folder that lasts in NUMBA_CACHE_DIR"
    assert folder.stat().st_mode & 0o777 == 0o700


def test_where_nothing_can_be_written_each_program_compiles(run, tmp_path):
    # Without any folder for temporary files Python looks for none either.
    code = "import tempfile; tempfile.gettempdir = lambda: '/proc/nonexistent'; " + KERNEL + RUN
    (path,), (told,) = run(code)
    assert json.loads(path) is None
    assert told.startswith("compiled code cannot be kept")


def test_a_folder_that_others_can_write_is_not_used(run, tmp_path):
    folder = tmp_path / f"avp-numba-{os.getuid()}"
    folder.mkdir()
    folder.chmod(0o777)
    (path,), (told,) = run(KERNEL + RUN)
    assert json.loads(path) is None
    assert told.startswith("compiled code cannot be kept")


@pytest.mark.parametrize("more", ["NUMBA_CACHE_DIR", "XDG_CACHE_HOME"])
def test_a_folder_that_the_user_names_is_used_without_a_word(run, tmp_path, more):
    named = tmp_path / "named"
    named.mkdir()
    (path,), told = run(KERNEL + RUN, **{more: str(named)})
    assert json.loads(path).startswith(str(named))
    assert told == []


def test_programs_that_are_started_use_the_same_folder_and_say_nothing(run, tmp_path):
    child = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {KERNEL + RUN!r}], check=True)"
    (path,), told = run(KERNEL + child)
    assert json.loads(path).startswith(str(tmp_path / "avp-numba-"))
    assert len(told) == 1


def test_the_doctor_says_where_compiled_code_is_kept(run, tmp_path):
    code = "from avp_habitat.doctor.__main__ import check_compiled as c; (f,) = c(); print(f.mark); print(f.text)"
    (mark, text), _ = run(code)
    assert (mark, text.startswith(f"kept in {tmp_path}/avp-numba-")) == ("ok", True)
    (tmp_path / f"avp-numba-{os.getuid()}").chmod(0o777)
    (mark, text), _ = run(code)
    assert (mark, "NUMBA_CACHE_DIR" in text) == ("--", True)


@pytest.mark.slow
def test_a_rollout_is_collected_there(run, tmp_path):
    options = ["--scene", "builtin:0", "--policy", "heuristic", "--budget", "2", "--width", "32", "--height", "24"]
    words = ("-m", "avp_habitat.collect", *options, "--out")
    run("rollout", words=words)
    assert (tmp_path / "rollout" / "rollout.json").is_file()


def test_every_kernel_is_compiled_by_the_one_function_that_knows_where_its_code_can_be_kept():
    def imports_numba(path):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
        names += [str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)]
        return any(name.partition(".")[0] == "numba" for name in names)

    packages = ("avp_habitat", "avp_sb3", "avp_nerfstudio")
    found = {path.name for package in packages for path in (ROOT / package).rglob("*.py") if imports_numba(path)}
    assert found == {"compiled.py"}
