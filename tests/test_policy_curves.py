import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avp_habitat.errors import UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    import policy_curves

    yield policy_curves
    del sys.modules["policy_curves"]


@pytest.fixture
def options(script, tmp_path):
    return script.PolicyCurves(
        ("builtin:3",),
        ("heuristic",),
        starts=2,
        reward="coverage",
        budget=6,
        views=(2, 6),
        out=tmp_path / "curves.json",
    )


def test_cells_are_run_once_and_again_by_other_settings_only(script, options, capsys):
    script.main(options)
    first = options.out.read_text()
    entry = json.loads(first)["cells"][0]
    assert [len(entry["episodes"]), entry["views_used"], entry["policy"]] == [2, 6.0, "heuristic"]
    for name in script.SHARES:
        values = np.array([episode[name] for episode in entry["episodes"]])
        assert (np.diff(values, axis=1) >= 0).all()
        assert entry["worst"][name] == pytest.approx(values.min(axis=0))
    assert 0 < entry["mean"]["visibility"][1] < 1
    script.main(options)
    assert json.loads(options.out.read_text())["cells"] == json.loads(first)["cells"]
    capsys.readouterr()
    script.main(replace(options, starts=1))
    assert [cell["starts"] for cell in json.loads(options.out.read_text())["cells"]] == [2, 1]
    assert capsys.readouterr().out.count("| builtin:3") == 1


def test_one_row_holds_the_episodes_of_all_scenes(script, options, capsys):
    both = replace(options, scene=("builtin:3", "builtin:4"), together=True)
    script.main(both)
    printed = capsys.readouterr().out
    cells = json.loads(options.out.read_text())["cells"]
    (entry,) = script.together(cells)
    assert entry["starts"] == len(entry["episodes"]) == 4
    mean = np.mean([cell["mean"]["visibility"] for cell in cells], axis=0)
    assert entry["mean"]["visibility"] == pytest.approx(mean, abs=1e-4)
    assert printed.count("| 2 scenes |") == 1
    assert script.together(cells[:1])[0]["starts"] == 2
    script.main(replace(both, scene=("builtin:3",)))
    assert capsys.readouterr().out.count("| 1 scenes |") == 1


def test_an_episode_that_stopped_keeps_its_last_value(script, options):
    simulator = open_simulator(SimulatorChoice(), "builtin:3")
    points = script.target_points(simulator, options.settings)
    poses = heldout_poses(simulator, sensor_height_m=1.5, views=20)
    camera = Intrinsics.from_hfov(160, 120, hfov_deg=90.0)
    found = script.episode(simulator, points, poses, camera, (1, 20, 80))["visibility"]
    assert found[0] < 0.6
    assert found[1] == found[2] > 0.97  # The held-out views themselves as frames.


def test_policies_that_sample_are_measured_both_ways(script, options):
    cells = script.cells_of(replace(options, policy=("survey", "walk.zip")))
    assert [(cell.policy, cell.sampled) for cell in cells] == [
        ("survey", False),
        ("walk.zip", False),
        ("walk.zip", True),
    ]


def test_views_beyond_the_budget_are_refused(script):
    with pytest.raises(UsageError, match="numbers from 1 to the budget 40"):
        script.PolicyCurves(("builtin:3",), ("heuristic",), budget=40)
