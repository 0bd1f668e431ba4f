import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from avp_habitat.rollout.format import read_rollout

ROOT = Path(__file__).resolve().parent.parent


def demo(*words, folder):
    """The demo as a user runs it; results go to `folder`."""
    env = {**os.environ, "MLFLOW_TRACKING_URI": f"sqlite:///{folder / 'mlflow.db'}", "PYTHONWARNINGS": "ignore"}
    line = [sys.executable, str(ROOT / "examples" / "demo.py"), *map(str, words)]
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=550, check=False)


@pytest.mark.slow
def test_the_demo_compares_three_methods_and_is_not_repeated(tmp_path):
    words = ("--out", "d", "--steps", 2048, "--iterations", 20, "--width", 40, "--height", 32)
    done = demo(*words, folder=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    table = json.loads((tmp_path / "d" / "table.json").read_text())["methods"]
    assert set(table) == {"heuristic", "random", "learned"}
    for method, figures in table.items():
        assert f"| {method}" in done.stdout
        assert 3 < figures["eval/psnr"] < 40
        assert (
            read_rollout(tmp_path / "d" / "rollouts" / method).meta["metrics"]["coverage"] == figures["eval/coverage"]
        )
    assert (tmp_path / "d" / "rollouts.rrd").stat().st_size > 10_000

    again = demo(*words, folder=tmp_path)
    assert again.returncode == 0
    assert again.stdout.count("done before") == 11
    other = demo("--out", "d", "--steps", 4096, folder=tmp_path)
    assert other.returncode == 2
    assert "holds a demo with other settings" in other.stderr


def test_a_stage_of_the_demo_is_waited_for_when_it_is_interrupted(tmp_path):
    program = tmp_path / "stage.py"
    program.write_text(
        "import pathlib, signal, sys, time\n"
        "def save(*_):\n"
        "    time.sleep(1)\n"
        "    pathlib.Path(sys.argv[1]).write_text('saved')\n"
        "    sys.exit(130)\n"
        "for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, save)\n"
        "pathlib.Path(sys.argv[1] + '-began').touch()\n"
        "time.sleep(60)\n"
    )
    code = (
        "import pathlib, sys; sys.path.insert(0, sys.argv[1]); import demo\n"
        "stage = demo.Demo(demo.Settings(), pathlib.Path('.'))\n"
        "sys.exit(demo.command.run(lambda _: stage.run('s', 'python', *sys.argv[2:])))"
    )
    for number, whom, name in ((signal.SIGINT, os.killpg, "a"), (signal.SIGTERM, os.kill, "b")):
        line = [sys.executable, "-c", code, str(ROOT / "examples"), str(program), name]
        with subprocess.Popen(line, cwd=tmp_path, start_new_session=True) as process:
            until = time.monotonic() + 60
            while not (tmp_path / f"{name}-began").exists() and time.monotonic() < until:
                time.sleep(0.05)
            whom(process.pid, number)
            assert process.wait(60) == 130
        assert (tmp_path / name).read_text() == "saved"
