"""`make demo` with small settings: real training, rollouts, reconstructions and recordings."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from avp_habitat.rollout.format import read_rollout

ROOT = Path(__file__).resolve().parent.parent


def demo(*words, folder):
    """The demo as a user runs it; results go to `folder`."""
    env = {**os.environ, "MLFLOW_TRACKING_URI": f"sqlite:///{folder / 'mlflow.db'}", "PYTHONPATH": str(ROOT)}
    line = [sys.executable, str(ROOT / "examples" / "demo.py"), *map(str, words)]
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=550, check=False)


@pytest.mark.slow
def test_the_demo_compares_four_methods_and_is_not_repeated(tmp_path):
    words = ("--out", "d", "--steps", 2048, "--iterations", 20, "--width", 40, "--height", 32)
    done = demo(*words, folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    head, _, *rows = [line for line in done.stdout.splitlines() if line.startswith("|")]
    assert "coverage [%]" in head
    assert "PSNR [dB]" in head
    assert {row.split()[1] for row in rows} == {"heuristic", "random", "pretrained", "pretrained_tuned"}
    for row in rows:
        rollout = tmp_path / "d" / "cells" / "collect" / f"{row.split()[1]}-builtin_0-0-0" / "rollout"
        assert f" {100 * read_rollout(rollout).meta['metrics']['coverage']:.1f} " in row
        assert (rollout / "trajectory.png").stat().st_size > 1000
    assert (tmp_path / "d" / "rollouts.rrd").stat().st_size > 10_000

    again = demo(*words, folder=tmp_path)
    assert again.returncode == 0
    assert "0 of 9 cells to do" in again.stdout
    other = demo("--out", "d", "--steps", 4096, folder=tmp_path)
    assert other.returncode == 2
    assert "holds an experiment of another configuration" in other.stderr
