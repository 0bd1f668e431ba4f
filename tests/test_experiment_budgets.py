"""Figures by part of the budget and by scene."""

import pytest
from experiment_results import FEW, SCENES, by_seed, interval, make_results, write_results

from avp_experiment import plots
from avp_experiment.report import write_report
from avp_experiment.results import read_results


@pytest.fixture
def report(tmp_path, monkeypatch):
    """Makes a report without figures, which take most of the time, and returns its folder."""
    monkeypatch.setattr("avp_experiment.report._figures", lambda shown: {})

    def make(results):
        write_report(write_results(tmp_path, results, pictures=False))
        return tmp_path

    return make


def test_the_tables_by_budget_hold_what_was_known_then(report):
    results = make_results(("greedy", "proposed"))
    method = results["methods"][1]
    page = (report(results) / "results.md").read_text()
    found = [one for one in results["rollouts"] if one["method"] == method and one["role"] == "unseen"]
    cells = []
    for views in (20, 40, 60, 80):
        values = by_seed(
            found, lambda one, views=views: 100 * one["visibility_curve"][min(views, len(one["visibility_curve"])) - 1]
        )
        mean, half = interval(values)
        cells.append(f"{mean:.1f} ± {half:.1f}")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if "|" in line]
    assert ["method", "20 views", "40 views", "60 views", "80 views"] in rows
    assert [method, *cells] in rows


def test_geometry_after_a_part_is_not_told_of_those_alone_that_have_ended(report):
    results = make_results(("greedy", "proposed"))
    for one in results["rollouts"]:
        one["geometry_after"] = {key: value for key, value in one["geometry_after"].items() if key == "40"}
    page = (report(results) / "results.md").read_text()
    lines = page.partition("completion ratio [%], unseen scenes:")[2].splitlines()
    assert [cell.strip() for cell in lines[2].strip("|").split("|")] == ["method", "40 views", "80 views"]


def test_a_method_without_a_scene_is_told_and_scenes_count_alike(report):
    results = make_results(("greedy", "proposed"), seeds=2)
    gone = {"method": "greedy", "scene": "grey.glb"}
    for part in ("rollouts", "reconstructions"):
        results[part] = [one for one in results[part] if any(one[name] != value for name, value in gone.items())]
    results["configuration"]["scenes"][0] = {**results["configuration"]["scenes"][0], "role": "unseen"}
    for part in ("rollouts", "reconstructions"):
        for one in results[part]:
            one["role"] = "unseen"
    folder = report(results)
    assert "greedy: without grey.glb, so that its means are of other scenes." in (folder / "table3.md").read_text()


def test_parts_of_different_budgets_stand_at_the_same_place(tmp_path):
    results = make_results(("greedy",), seeds=2, starts=1, prefixes=(40,))
    scenes = [{**scene, "role": "unseen"} for scene in SCENES]
    scenes[1]["budget"] = 160
    results["configuration"]["scenes"] = scenes
    for part in ("rollouts", "reconstructions"):
        for one in results[part]:
            one["role"] = "unseen"
    for one in results["reconstructions"]:
        if one["scene"] == "grey.glb":
            one["views"] = 160
            one["frames"] = 160 if one["whole"] else 80
    found = read_results(write_results(tmp_path, results))
    axes = plots.psnr_by_views(found).picture.axes[0]
    assert axes.lines[0].get_xdata().tolist() == [50.0, 100.0]


def test_each_unseen_scene_has_its_own_completion_ratio_and_psnr(report):
    results = make_results(FEW)
    page = (report(results) / "results.md").read_text().partition("## By scene")[2]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if "|" in line]
    for part, value in (
        ("rollouts", lambda one: 100 * one["metrics"]["completion_ratio"]),
        ("reconstructions", lambda one: one["scores"]["psnr"]),
    ):
        whole = {"whole": True} if part == "reconstructions" else {}
        mean, half = interval(by_seed(results[part], value, method="proposed", scene="grey.glb", **whole))
        digits = 1 if part == "rollouts" else 2
        assert ["proposed", f"{mean:.{digits}f} ± {half:.{digits}f}"] in rows
