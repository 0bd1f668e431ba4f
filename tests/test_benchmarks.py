import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from nerfstudio_room import write_room

from avp_habitat import command
from avp_habitat.poses import Intrinsics
from avp_habitat.scenes.loader import load_scene

FOLDER = Path(__file__).resolve().parent.parent / "benchmarks"


def run(script, *words, folder):
    """A benchmark as a user runs it; its report goes to `folder`."""
    line = [sys.executable, str(FOLDER / script), *map(str, words), "--out", "report.json"]
    env = {**os.environ, "PYTHONWARNINGS": "ignore"}
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=550, check=False)


def report(done, folder):
    assert done.returncode == 0, done.stderr
    assert "report.json: the whole report" in done.stdout
    assert [path.name for path in folder.iterdir()] == ["report.json"]
    read = json.loads((folder / "report.json").read_text())
    assert set(read) == {
        *("format_version", "benchmark", "complete", "time", "command", "options", "git_commit", "versions"),
        *("machine", "results"),
    }
    assert set(read["machine"]) >= {"cpus", "cpu_model", "memory_bytes", "load_average"}
    assert read["complete"] is True
    assert read["command"].startswith(f"python benchmarks/{read['benchmark']}.py --")
    return read["results"]


def positive(row, *keys):
    assert all(row[key] > 0 for key in keys), row


@pytest.fixture
def modules(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))


def test_the_benchmark_of_the_environment_sets_steps_beside_their_rays(tmp_path):
    words = ("--scene", "builtin:1", "--agents", 1, 3, "--resolutions", "16x12", "--seconds", 0.03)
    results = report(run("environment.py", *words, folder=tmp_path), tmp_path)
    assert [(row["agents"], row["lookup"], row["image"]) for row in results["environment"]] == [
        *((agents, lookup, "16x12") for agents in (1, 3) for lookup in ("off", "on")),
    ]
    for row in results["environment"]:
        positive(row, "steps_per_s", "raw_rays_per_s", "raw_steps_per_s", "share")
        assert (row["rays_cast_per_step"] > 16 * 12) == (row["lookup"] == "off")
    positive(results["tables"][0], "cells", "area_m2", "build_s", "places", "memory_mb")


def test_the_benchmark_of_geometry_changes_one_choice_at_a_time(tmp_path):
    from avp_habitat import collect

    words = ["--scene", "builtin:1", "--policy", "spin", "--budget", "4", "--width", "32", "--height", "24"]
    assert command.run(collect.main, [*words, "--out", str(tmp_path / "r")]) == 0
    (tmp_path / "b").mkdir()
    rows = report(
        run(
            "geometry.py", "--rollout", tmp_path / "r", "--scene", "builtin:1", "--factors", 1.5, folder=tmp_path / "b"
        ),
        tmp_path / "b",
    )["geometry"]
    changed = [{name for name in list(row)[:4] if row[name] != rows[0][name]} for row in rows[1:]]
    assert changed == [{"voxel_m"}, {"truncation_m"}, {"samples"}, {"places"}]
    for row in rows:
        positive(row, "completion_ratio", "precision", "truth_s", "fuse_s", "score_s")
    assert rows[0]["moved"] == 0


def test_the_benchmark_of_scenes_measures_rooms_and_halls(tmp_path):
    words = ("--triangles", 1, "--halls", 9, "--tables-m2", 0.02, "--steps", 48, "--width", 16, "--height", 12)
    results = report(run("scenes.py", *words, folder=tmp_path), tmp_path)
    assert [row["series"] for row in results["scenes"]] == ["room", "hall"]
    assert [row["triangles"] for row in results["tables"]] == [15722, 12]
    for row in results["scenes"]:
        positive(row, "cells", "area_m2", "load_s", "area_s", "lookup_steps_per_s", "cast_steps_per_s")
    for row in results["tables"]:
        positive(row, "table_s_per_m2", "memory_mb_per_m2", "disk_mb_per_m2", "whole_s", "whole_disk_mb")
        assert 0 < row["made_share"] <= 1


def test_the_benchmark_of_generation_sets_a_home_beside_a_room(tmp_path):
    results = report(run("generation.py", "--seeds", 5, folder=tmp_path), tmp_path)
    assert [row["scene"] for row in results["scenes"]] == ["builtin:5", "builtin-home:5"]
    rooms, homes = (row["median_m2"] for row in results["kinds"])
    assert rooms == pytest.approx(28.0, abs=0.1)
    assert homes == pytest.approx(34.0, abs=0.15)
    for row in results["kinds"]:
        positive(row, "cpu_s_per_m2", "triangles_per_m2")


def test_the_benchmark_of_export_sets_written_views_beside_their_rays(tmp_path):
    words = ("--scene", "builtin:1", "--views", 3, "--rounds", 2, "--width", 48, "--height", 36)
    (row,) = report(run("export.py", *words, folder=tmp_path), tmp_path)["export"]
    assert (row["scene"], row["views"]) == ("builtin:1", 3)
    positive(row, "export_s", "first_s", "kb_per_view", "rays_cpu_ms")
    assert 0 < row["cpu_share"] < 1
    assert row["share"] == pytest.approx(row["export_per_s"] / row["rays_per_s"])


@pytest.mark.slow
def test_the_benchmark_of_training_compares_five_ways_and_measures_memory(tmp_path):
    words = ("--repeats", 1, "--steps", 1, "--cast-steps", 1, "--single-steps", 1, "--raw-seconds", 0.1)
    results = report(run("training.py", *words, "--memory-agents", 16, "--memory-steps", 1, folder=tmp_path), tmp_path)
    assert [row["way"] for row in results["training"]] == [
        *("tables, all callbacks", "tables, metrics + MLflow", "tables", "rays", "single, rays, all callbacks"),
    ]
    for row in results["training"]:
        positive(row, "steps_per_s", "s_for_300000_steps")
        assert row["steps"] == 2048
        assert row["all"] == [row["steps_per_s"]]
    compared = {row["what"]: row["median"] for row in results["comparison"]}
    assert compared["rays of the definition per step"] > 160 * 120
    assert compared["raw rays/s"] > 0
    assert [(row["tables_on_disk"], row["agents"]) for row in results["processes"]] == [(False, 16), (True, 16)]
    for row in results["processes"]:
        positive(row, "startup_s", "imports_mb", "above_imports_mb")


@pytest.mark.parametrize(
    ("script", "words", "error"),
    [
        ("environment.py", ("--agents", 4, 0), "--agents: expected at least 1, got 0"),
        ("environment.py", ("--resolutions", "64"), "--resolutions: expected WIDTHxHEIGHT"),
        ("export.py", ("--views", 0), "--views: expected at least 1, got 0"),
        ("scenes.py", ("--halls", 0), "--halls: expected at least 1, got 0"),
        ("training.py", ("--memory-agents", 3), "--agents, --memory-agents: expected divisors of 2048, got 3"),
    ],
)
def test_wrong_options_end_before_anything_is_measured(tmp_path, script, words, error):
    done = run(script, *words, folder=tmp_path)
    assert done.returncode == 2, done.stderr
    assert error in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("modules")
def test_what_was_measured_before_an_interruption_is_kept(tmp_path, capsys):
    import reporting

    options = reporting.parser("", "x").parse_args(["--out", str(tmp_path / "x.json")])

    def measure():
        with reporting.reported("x", options) as results:
            results["rates"] = [{"agents": 4, "rate": 1234.5}]
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure()
    read = json.loads((tmp_path / "x.json").read_text())
    assert read["complete"] is False
    assert read["results"] == {"rates": [{"agents": 4, "rate": 1234.5}]}
    assert "agents   rate\n------  -----\n     4  1,234\n" in capsys.readouterr().out


@pytest.mark.usefixtures("modules")
def test_rays_are_remembered_only_between_start_and_stop_and_cast_again():
    from rays import RecordingSimulator

    simulator = RecordingSimulator(load_scene("builtin:0"))
    pose, eye = np.tile(np.eye(4), (2, 1, 1)), np.zeros((2, 3))
    camera = Intrinsics.from_hfov(8, 6, hfov_deg=90)
    points, pairs = np.array([[0.0, 0.0, -1.0]]), np.array([[0, 0], [1, 0]])
    simulator.render(pose, camera, rgb=False)
    simulator.start()
    simulator.render(pose, camera, rgb=False)
    simulator.visible(pose, camera, points, pairs, tolerance_m=0.1)
    simulator.stop()
    simulator.reached(eye, points, pairs, tolerance_m=0.1)
    assert simulator.count == 2 * 8 * 6 + 2
    assert simulator.replay()[0] == simulator.count
    assert simulator.replay(seconds=0.0)[0] == 2 * 8 * 6


@pytest.mark.usefixtures("modules")
def test_subdividing_keeps_the_surface_closed_and_within_two_millimetres():
    from scenes import hall, subdivided

    mesh = hall(9.0)
    fine = subdivided(mesh, 3)
    assert len(fine.triangles) == 9 * len(mesh.triangles)
    # On the walls of the hall before the corners were moved.
    depth = np.minimum(np.abs(fine.vertices), np.abs(fine.vertices - [3.0, 3.0, 3.0])).min(axis=1)
    assert 0 < depth.max() < 0.0021
    # Every edge belongs to two triangles, found by place because triangles do not share corners.
    _, place = np.unique(np.round(fine.vertices, 5), axis=0, return_inverse=True)
    corners = place.reshape(-1)[fine.triangles]
    edges = np.sort(corners[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()

    # All faces are still turned the way they were.
    def normal(m):
        a, b, c = m.vertices[m.triangles].transpose(1, 0, 2).astype(np.float64)
        return np.cross(b - a, c - a)

    assert (np.einsum("ij,ij->i", normal(fine), np.repeat(normal(mesh), 9, axis=0)) > 0).all()
    assert np.linalg.norm(normal(fine), axis=1).sum() == pytest.approx(
        np.linalg.norm(normal(mesh), axis=1).sum(), rel=0.01
    )


@pytest.mark.slow
def test_the_benchmark_of_the_dataparser_measures_both_splits(tmp_path):
    words = ("--frames", 9, "--width", 32, "--height", 24, "--pictures", 4)
    results = report(run("dataparser.py", *words, folder=tmp_path), tmp_path)
    assert any(rows for rows in results.values())


@pytest.mark.slow
def test_the_benchmark_of_reconstruction_trains_scores_and_does_nothing_twice(tmp_path, tmp_path_factory):
    room, cells = write_room(tmp_path / "room"), tmp_path_factory.mktemp("cells")
    words = ("--data", room, "--minutes", 0, "--iterations", 60, "--score-every", 2, "--pictures", 0)
    words = (*words, "--ways", "avp-nerfacto", "nerfacto-tiny", "--cells", cells)
    done = run("reconstruction.py", *words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "report.json").read_text())["results"]
    rows = results["60 iterations"]
    assert [row["way"] for row in rows] == ["avp-nerfacto", "nerfacto-tiny"]
    for row in rows:
        positive(row, "train_s", "score_s", "memory_gb")
        assert (row["iterations"], row["views"]) == (60, 1)
        assert 3 < float(row["psnr_db"]) < 60
    assert (tmp_path / "report.jpg").is_file()
    assert "| avp-nerfacto | 60 |" in (tmp_path / "report.md").read_text()
    made = {path: path.stat().st_mtime_ns for path in cells.rglob("result.json")}
    run("reconstruction.py", *words, folder=tmp_path)
    assert {path: path.stat().st_mtime_ns for path in cells.rglob("result.json")} == made
