import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import experiment_walks
import pytest

from avp_experiment.folder import DONE, Folder
from avp_habitat.rollout.format import read_rollout

ROOT = Path(__file__).resolve().parent.parent
PROGRAM = Path(experiment_walks.__file__)


def start(folder, *more):
    """The small experiment as a process of its own, which leads a session, so that nothing else gets its signals."""
    env = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    words = [sys.executable, str(PROGRAM), str(folder), *map(str, more)]
    return subprocess.Popen(words, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                            start_new_session=True)  # fmt: skip


def done(folder):
    return sorted(folder.glob(f"cells/*/*/{DONE}"))


def wait_for(condition, seconds=300):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "waited too long"
        time.sleep(0.05)


def processes_of(session):
    """Numbers of the processes of a session that still run."""
    found = subprocess.run(["ps", "-o", "pid=,stat=", "--sid", str(session)], capture_output=True, text=True).stdout
    return [line.split()[0] for line in found.splitlines() if not line.split()[1].startswith("Z")]


def test_killed_half_way_it_goes_on_with_what_is_missing_and_repeats_nothing(tmp_path):
    first = start(tmp_path)
    wait_for(lambda: len(done(tmp_path)) >= 2)
    os.kill(first.pid, signal.SIGKILL)
    first.communicate()
    # What the killed program had begun ends with it, or two programs would write one rollout.
    wait_for(lambda: not processes_of(first.pid), 20)
    before = {path: path.read_bytes() for path in done(tmp_path)}
    assert 2 <= len(before) < 6
    second = start(tmp_path)
    failed, errors = second.communicate(timeout=300)
    assert (second.returncode, json.loads(failed)) == (0, {}), errors
    assert len(done(tmp_path)) == 6
    assert {path: path.read_bytes() for path in before} == before
    for cell in experiment_walks.rollouts(tmp_path):
        assert len(read_rollout(cell.output(tmp_path)).frames) == 3
        record = Folder(tmp_path).record(cell)
        assert len(record["facts"]["coverage_curve"]) == 3
        assert record["facts"]["visibility_curve"][-1] == pytest.approx(
            record["facts"]["metrics"]["visibility"], abs=1e-6
        )


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_no_cell_outlives_the_experiment(tmp_path, number):
    program = tmp_path / "waits.py"
    program.write_text(f"import pathlib, time\ndef main(argv):\n    pathlib.Path({str(tmp_path)!r}, 'begun').touch()\n"
                       "    time.sleep(600)\n")  # fmt: skip
    experiment = start(tmp_path, program.stem)
    wait_for((tmp_path / "begun").exists)
    assert len(processes_of(experiment.pid)) > 1
    os.kill(experiment.pid, number)
    experiment.communicate()
    wait_for(lambda: not processes_of(experiment.pid), 20)


def test_an_interruption_ends_what_is_running_and_keeps_what_is_done(tmp_path):
    program = start(tmp_path)
    wait_for(lambda: len(done(tmp_path)) >= 1)
    os.killpg(program.pid, signal.SIGINT)
    program.communicate(timeout=60)
    assert program.returncode != 0
    wait_for(lambda: not processes_of(program.pid), 20)
    assert 1 <= len(done(tmp_path)) < 6
    assert not list(tmp_path.glob("cells/*/*/failed.json"))


def test_a_cell_that_fails_is_told_with_its_reason_and_the_others_are_done(tmp_path):
    whole, other = experiment_walks.rollouts(tmp_path)[:2]
    lost = replace(other, words=tuple(word.replace("builtin:0", "gone.glb") for word in other.words))
    after = replace(other, name="after", needs=lost)
    runner = experiment_walks.run(tmp_path, [lost, after, whole], jobs=2)
    folder = Folder(tmp_path)
    assert set(runner.failed) == {lost.key, after.key}
    assert "gone.glb" in runner.failed[lost.key]
    assert runner.failed[lost.key].startswith("exit code 1: ")
    assert runner.failed[after.key] == f"needs {lost.key}, which failed"
    assert "gone.glb" in folder.failure(lost)
    assert folder.is_done(whole)
    # Tried again, and better, it is not called failed any more.
    assert experiment_walks.run(tmp_path, [other, whole]).failed == {}
    assert folder.is_done(other)
    assert folder.failure(other) is None


def test_a_command_that_dies_is_told_by_its_signal(tmp_path, monkeypatch):
    cell = experiment_walks.rollouts(tmp_path)[0]
    (tmp_path / "dies.py").write_text("import os, signal\ndef main(argv):\n    os.kill(os.getpid(), signal.SIGSEGV)\n")
    monkeypatch.syspath_prepend(tmp_path)
    runner = experiment_walks.run(tmp_path, [replace(cell, words=("python", "-m", "dies"))])
    assert runner.failed[cell.key].startswith("killed by signal 11")


def test_a_method_that_raises_in_the_middle_of_an_episode_fails_alone(tmp_path, monkeypatch):
    whole, other = experiment_walks.rollouts(tmp_path)[:2]
    (tmp_path / "theirs.py").write_text(
        "class Tires:\n"
        "    def __init__(self, env, seed=None):\n"
        "        self.views = 0\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=False):\n"
        "        self.views += 1\n"
        "        if self.views > 2:\n"
        "            raise RuntimeError('too tired for view 3')\n"
        "        return 1, None\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    words = list(other.words)
    words[words.index("--policy") + 1] = "theirs:Tires"
    tired = replace(other, words=tuple(words))
    runner = experiment_walks.run(tmp_path, [tired, whole])
    assert list(runner.failed) == [tired.key]
    assert "too tired for view 3" in runner.failed[tired.key]
    assert not tired.output(tmp_path).exists()
    assert Folder(tmp_path).is_done(whole)
