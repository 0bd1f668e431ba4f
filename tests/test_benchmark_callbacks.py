import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parent.parent / "benchmarks" / "callbacks.py"


def run(*words, folder):
    env = {**os.environ, "PYTHONWARNINGS": "ignore"}
    line = [sys.executable, str(SCRIPT), *map(str, words), "--out", "overhead.json"]
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=900, check=False)


@pytest.mark.slow
def test_the_benchmark_measures_every_callback_and_writes_a_page(tmp_path):
    sizes = ("--repeats", 2, "--steps", 2048, "--delay-steps", 8192, "--episodes", 2, "--seed", 7)
    done = run(*sizes, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["overhead.json", "overhead.md"]
    report = json.loads((tmp_path / "overhead.json").read_text())
    results = report["results"]
    ways = ["none", "metrics", "MLflow", "Rerun", "evaluation", "all"]
    assert [row["callbacks"] for row in results["training"]] == ways
    for row in results["training"]:
        assert row["steps"] == 2048
        assert row["steps_per_s"] == pytest.approx(2048 / row["seconds"], rel=0.5)
        assert min(row["steps_per_cpu_s"], row["around_s"]) > 0
    assert [row["callbacks"] for row in results["cost"]] == ways[1:]
    assert all(len(row["all"]) == len(row["all_of_cpu"]) == 2 for row in results["cost"])
    assert results["recording"][0]["episodes"] >= 2
    assert results["recording"][0]["bytes_per_episode"] > 10_000
    assert results["delay"][0]["points"] >= 1
    assert 0 < results["delay"][0]["median_s"] <= results["delay"][0]["longest_s"]
    page = (tmp_path / "overhead.md").read_text()
    assert report["command"] in page
    assert "- Seed: 7" in page
    assert "| evaluation | 2,048 |" in page


def test_wrong_options_of_the_benchmark_are_named(tmp_path):
    for words, error in (
        (("--agents", 3), "--agents: expected a divisor of 2048, got 3"),
        (("--repeats", 0), "--repeats: expected at least 1, got 0"),
    ):
        done = run(*words, folder=tmp_path)
        assert done.returncode == 2
        assert error in done.stderr
    assert list(tmp_path.iterdir()) == []
