import csv
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from experiment_results import SCENES, make_results, write_results
from PIL import Image
from scipy import stats

from avp_experiment import plots
from avp_experiment.pictures import maps
from avp_experiment.report import main, write_report
from avp_experiment.results import read_results
from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.metrics import Figure

ROOT = Path(__file__).resolve().parent.parent
FIGURES = ("figure3", "figure4", "figure5", "figure6", "figure6_unseen", "psnr_by_views", "visibility")
FEW = ("heuristic", "coverage", "proposed", "surface")
TRAIN_ONLY = SCENES[:1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Results of all methods, and the folder of their report."""
    results = make_results()
    folder = write_results(tmp_path_factory.mktemp("whole"), results)
    write_report(folder)
    return results, folder


@pytest.fixture
def report(tmp_path, monkeypatch):
    """Makes a report without figures, which take most of the time, and returns its folder."""
    monkeypatch.setattr("avp_experiment.report._figures", lambda shown: {})

    def make(results):
        write_report(write_results(tmp_path, results, pictures=False))
        return tmp_path

    return make


def rows_of(path):
    with path.open(newline="", encoding="utf-8") as file:
        return {row["method"]: row for row in csv.DictReader(file)}


def by_seed(parts, value, **wanted):
    """Means of a figure by seed, computed without the report's code."""
    found = {}
    for part in parts:
        if all(part[name] == wish for name, wish in wanted.items()):
            found.setdefault(part["seed"], []).append(value(part))
    return [sum(values) / len(values) for values in found.values()]


def interval(values):
    """Mean and half width of the 95 % interval, as SciPy computes it."""
    mean = float(np.mean(values))
    low, high = stats.t.interval(0.95, len(values) - 1, loc=mean, scale=stats.sem(values))
    return mean, (high - low) / 2


@pytest.mark.parametrize(("table", "role"), [("table2", "train"), ("table3", "unseen")])
def test_the_tables_hold_means_and_intervals_over_seeds(whole, table, role):
    results, folder = whole
    rows, text = rows_of(folder / f"{table}.csv"), (folder / f"{table}.md").read_text()
    assert list(rows) == results["methods"]
    for method in results["methods"]:
        of = {"method": method, "role": role}
        figures = {
            "coverage [%]": by_seed(results["rollouts"], lambda one: 100 * one["metrics"]["coverage"], **of),
            "EI [%/view]": by_seed(results["rollouts"], lambda one: 100 * one["metrics"]["ei"], **of),
            "PSNR [dB]": by_seed(results["reconstructions"], lambda one: one["scores"]["psnr"], whole=True, **of),
        }
        for title, values in figures.items():
            mean, half = interval(values)
            assert float(rows[method][title]) == pytest.approx(mean, rel=1e-5)
            assert float(rows[method][f"± {title}"]) == pytest.approx(half, rel=1e-4)
        mean, half = interval(figures["PSNR [dB]"])
        (line,) = [line for line in text.splitlines() if line.startswith(f"| {method} ")]
        assert f" {mean:.2f} ± {half:.2f} " in line


@pytest.mark.parametrize("role", ["train", "unseen"])
@pytest.mark.parametrize("of", ["geometry", "model"])
def test_geometry_has_tables_of_its_own(whole, of, role):
    results, folder = whole
    table = {"train": "table2", "unseen": "table3"}[role]
    for method, row in rows_of(folder / f"{table}_{of}.csv").items():
        whose = {"method": method, "role": role}
        if of == "model":
            found = results["reconstructions"]
            ratio = by_seed(found, lambda one: 100 * one["geometry"]["completion_ratio"], whole=True, **whose)
        else:
            ratio = by_seed(results["rollouts"], lambda one: 100 * one["metrics"]["completion_ratio"], **whose)
        mean, half = interval(ratio)
        assert float(row["completion ratio [%]"]) == pytest.approx(mean, rel=1e-5)
        assert float(row["± completion ratio [%]"]) == pytest.approx(half, rel=1e-4)
        assert float(row["accuracy [cm]"]) == pytest.approx(0.1)
    assert f"| {results['methods'][0]} " in (folder / "results.md").read_text().partition("geometry: ")[2]


def test_another_number_in_the_results_is_another_number_in_the_table(report):
    results = make_results(FEW, scenes=TRAIN_ONLY)
    before = (report(results) / "table2.md").read_text()
    changed = next(one for one in results["reconstructions"] if one["method"] == "proposed" and one["whole"])
    changed["scores"]["psnr"] += 3
    after = (report(results) / "table2.md").read_text()
    different = [a for a, b in zip(before.splitlines(), after.splitlines(), strict=True) if a != b]
    assert [line.split()[1] for line in different] == ["proposed"]


@pytest.mark.parametrize("name", FIGURES)
def test_every_figure_is_a_picture_of_modest_size_with_something_in_it(whole, name):
    path = whole[1] / f"{name}.png"
    assert path.stat().st_size < 300_000
    with Image.open(path) as picture:
        assert 700 <= picture.width <= 1200
        assert len(picture.getcolors()) > 50


def test_the_page_holds_tables_figures_claims_and_where_they_come_from(whole):
    _, folder = whole
    page = (folder / "results.md").read_text()
    for part in ("mlflow run . -e compare", "0123456789ab", "a processor", "torch 2.9", "3 seeds"):
        assert part in page
    for name in FIGURES:
        assert f"]({name}.png)" in page
    assert (folder / "table2.md").read_text().splitlines()[2] in page
    assert "### What predicts PSNR" in page
    assert page.rstrip().endswith("Nothing.")


def test_what_was_read_by_hand_becomes_part_of_the_page(report, tmp_path):
    (tmp_path / "reading.md").write_text("# What this shows\n\nA room of one's own.\n")
    page = (report(make_results(FEW)) / "results.md").read_text()
    assert "## What this shows\n\nA room of one's own." in page


def section(folder, title):
    return (folder / "claims.md").read_text().partition(f"## {title}")[2].partition("\n## ")[0]


def change(results, method, **by):
    """Add to views or PSNR, or multiply coverage, of all episodes of a method."""
    for one in results["rollouts"]:
        if one["method"] == method:
            one["metrics"]["views"] += by.get("views", 0)
            one["metrics"]["coverage"] *= by.get("coverage", 1)
    for one in results["reconstructions"]:
        if one["method"] == method:
            one["scores"]["psnr"] += by.get("psnr", 0)


@pytest.mark.parametrize(
    ("method", "by", "words"),
    [
        ("heuristic", {}, "the heuristic is clearly below every learned policy in coverage and PSNR"),
        ("heuristic", {"psnr": 20}, "the heuristic is **not** below every learned policy in coverage and PSNR"),
        ("heuristic", {"coverage": 5}, "the heuristic is **not** below"),
        ("surface", {"psnr": -8.2}, "not every difference has an interval above 0"),
    ],
)
def test_the_heuristic_is_called_worse_only_where_it_is(report, method, by, words):
    results = make_results(FEW, scenes=TRAIN_ONLY)
    change(results, method, **by)
    assert words in section(report(results), "Heuristic")


@pytest.mark.parametrize(
    ("by", "words"),
    [
        ({"psnr": 2}, "**holds**, also at the unfavourable ends"),
        ({"psnr": 0.1}, "**holds** by the means, not over the whole intervals"),
        ({"psnr": -2}, "**does not hold**"),
        ({"psnr": 2, "views": 20}, "**does not hold**"),
    ],
)
def test_fewer_views_at_equal_psnr_holds_only_where_it_does(report, by, words):
    results = make_results(FEW, scenes=TRAIN_ONLY)
    # Less scatter between seeds, so that the whole interval of the views lies on one side.
    for one in results["rollouts"]:
        if one["method"] == "proposed":
            one["metrics"]["views"] = 54.0 + one["seed"]
    change(results, "proposed", **by)
    said = section(report(results), "`proposed` against `coverage`")
    assert words in said
    share = np.mean([1 - (54 + seed + by.get("views", 0)) / 80 for seed in range(3)])
    assert f"takes {100 * share:.1f} ± " in said


def test_surface_is_compared_at_equal_views_and_at_equal_psnr(report):
    results = make_results(("proposed", "surface"), scenes=TRAIN_ONLY, starts=1, prefixes=(20, 40))
    exact = {"proposed": {20: 10.0, 40: 14.0, 50: 15.0}, "surface": {20: 12.0, 40: 16.0, 60: 18.0}}
    for one in results["reconstructions"]:
        one["views"] = {"proposed": 50, "surface": 60}[one["method"]]
        one["frames"] = one["views"] if one["whole"] else one["frames"]
        one["scores"]["psnr"] = exact[one["method"]][one["frames"]] + 0.5 * one["seed"]
    said = section(report(results), "`surface` against")
    # At 50 views surface lies half way between 16 and 18, proposed at 15; 15 is three quarters of the way to 16.
    assert "differs by +2.00 ± 0.00 dB: higher, the whole interval too" in said
    assert (
        "reached by `surface` after 35.0 ± 0.0 views where `proposed` took 50.0 ± 0.0: +15.0 ± 0.0 views saved." in said
    )
    assert "The final PSNR of `surface` is reached by `proposed` in none of 3 episodes: never reached." in said
    change(results, "surface", psnr=-6)
    assert "differs by -4.00 ± 0.00 dB: lower, the whole interval too" in section(report(results), "`surface` against")


def test_the_correlation_is_that_of_scipy_and_called_what_it_is(report):
    results = make_results(FEW, scenes=TRAIN_ONLY)
    known = [(one["visibility"], one["scores"]["psnr"]) for one in results["reconstructions"]]
    rho = stats.spearmanr(*zip(*known, strict=True))[0]
    said = section(report(results), "What predicts PSNR")
    assert f"visibility predicts PSNR best: ρ = {rho:.2f} [" in said
    for one in results["reconstructions"]:
        one["scores"]["psnr"] = 30 * one["visibility"]
    assert "best: ρ = 1.00 [1.00, 1.00], at least 0.8" in section(report(results), "What predicts PSNR")
    for one in results["reconstructions"]:
        one["scores"]["psnr"] = -one["scores"]["psnr"]
    assert "best: ρ = -1.00 [-1.00, -1.00], below 0.8" in section(report(results), "What predicts PSNR")


def test_what_predicts_best_is_named_whichever_it_is(report):
    results = make_results(FEW, scenes=TRAIN_ONLY)
    rng = np.random.default_rng(3)
    for one in results["rollouts"]:
        one["visibility_curve"] = list(rng.random(len(one["visibility_curve"])))
        one["coverage_curve"] = list(rng.random(len(one["coverage_curve"])))
        one["parallax_curve"] = list(rng.random(len(one["parallax_curve"])))
    known = {(one["method"], one["seed"], one["start"]): one for one in results["rollouts"]}
    for one in results["reconstructions"]:
        found = known[one["method"], one["seed"], one["start"]]
        geometry = found["metrics"] if one["whole"] else found["geometry_after"][str(one["frames"])]
        one["scores"]["psnr"] = geometry["completion_ratio"]
    assert "completion ratio predicts PSNR best: ρ = 1.00" in section(report(results), "What predicts PSNR")


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


def test_a_failed_cell_is_named_with_its_reason(report):
    results = make_results(FEW)
    results["failed"] = [{"cell": "train/surface-1", "reason": "exit code 1: no memory", "log": "cells/log.txt"}]
    assert "`train/surface-1`: exit code 1: no memory" in section(report(results), "Cells that failed")


def without(part, **wanted):
    """Drops entries from a part of the results."""

    def drop(results):
        results[part] = [one for one in results[part] if not all(one[name] == value for name, value in wanted.items())]

    return drop


def without_value(part, **values):
    return lambda results: [one.update(values) for one in results[part]]


def incomplete(folder, drop):
    results = make_results(FEW, scenes=TRAIN_ONLY, starts=1, prefixes=(40,))
    drop(results)
    return write_results(folder, results, pictures=False)


TABLES = {
    "no reconstruction": (without("reconstructions"), "No PSNR [dB]: no whole episode was reconstructed"),
    "no proposed": (without("rollouts", method="proposed"), "No episode of proposed."),
    "a seed less": (
        without("reconstructions", method="surface", seed=1),
        "Of fewer than 3 reconstructions: surface 2.",
    ),
    "no whole ones": (without("reconstructions", whole=True), "no whole episode was reconstructed"),
}


@pytest.mark.parametrize("missing", TABLES)
def test_what_is_not_in_a_table_is_said_below_it(report, missing):
    drop, words = TABLES[missing]
    results = make_results(FEW, scenes=TRAIN_ONLY, starts=1, prefixes=(40,))
    drop(results)
    page = (report(results) / "results.md").read_text()
    assert words in page
    assert "Table 3: unseen scenes, no retraining: no such scene" in page
    assert "nan" not in page
    assert "None]" not in page


FIGURES_LEFT_OUT = {
    "no reconstruction": (plots.psnr_by_views, without("reconstructions"), "no reconstruction has a PSNR"),
    "no training": (plots.reward_while_training, without("training"), "no training has a curve of rollout/ep_rew_mean"),
    "no map": (
        maps,
        without_value("rollouts", map=None),
        "no episode of heuristic, coverage, proposed has a map",
    ),
    "no visibility": (
        plots.predictors_and_psnr,
        without("rollouts"),
        "no reconstruction has both a visibility and a PSNR",
    ),
}


@pytest.mark.parametrize("missing", FIGURES_LEFT_OUT)
def test_a_figure_without_data_says_why_it_cannot_be_made(tmp_path, missing):
    draw, drop, words = FIGURES_LEFT_OUT[missing]
    with pytest.raises(plots.Missing, match=words):
        draw(read_results(incomplete(tmp_path, drop)))


def test_a_map_that_is_missing_is_said(tmp_path):
    folder = incomplete(
        tmp_path, lambda results: [one.update(map=None) for one in results["rollouts"] if one["method"] == "coverage"]
    )
    assert maps(read_results(folder)).caption.endswith("No map of coverage.")


def test_an_experiment_without_results_is_a_page_that_says_so_and_no_figure_of_before_outlives_its_data(tmp_path):
    folder = incomplete(
        tmp_path, lambda results: results.update({part: [] for part in ("training", "rollouts", "reconstructions")})
    )
    (folder / "figure3.png").touch()
    page = write_report(folder).read_text()
    for part in ("Table 2: scenes of training: no episode there is done", "no training has a curve of avp/cpv"):
        assert part in page
    assert "### Cells that failed" in page
    assert not (folder / "figure3.png").exists()


def test_a_figure_that_a_user_added_is_a_column_in_its_unit(report):
    results = make_results(FEW, scenes=TRAIN_ONLY, seeds=2, starts=1)
    turned = Figure("turned", "turned", "°", scale=10, digits=0, better="lower")
    results["figures"] = {"turned": asdict(turned)}
    for one in results["rollouts"]:
        one["metrics"]["turned"] = 7.0
    folder = report(results)
    assert "| turned [°] |" in (folder / "table2.md").read_text()
    assert {row["turned [°]"] for row in rows_of(folder / "table2.csv").values()} == {"70"}


def test_one_seed_has_no_intervals_and_no_lpips_is_said(report):
    results = make_results(("heuristic", "proposed", "coverage"), seeds=1, starts=1, lpips=False)
    folder = report(results)
    page, table = ((folder / name).read_text() for name in ("results.md", "table2.md"))
    assert "±" not in table
    assert "LPIPS |" not in table
    assert "No LPIPS: its weights are not there." in table
    assert "one seed: no interval" in page
    assert "nan" not in page
    # Bars of an unknown length are no warnings of NumPy's, which are errors here.
    assert "Means over 1 seed," in plots.psnr_by_views(read_results(folder)).caption


def spoiled(folder, change):
    value = make_results(FEW, scenes=TRAIN_ONLY, starts=1)
    change(value)
    (folder / "results.json").write_text(json.dumps(value))


BAD = {
    "no results": (lambda folder: None, 2, "expected the folder of an experiment"),
    "not JSON": (lambda folder: (folder / "results.json").write_text("{"), 1, "results.json: expected JSON"),
    "a list": (
        lambda folder: (folder / "results.json").write_text("[]"),
        1,
        "expected results of format 1, found 'list'",
    ),
    "another format": (lambda folder: spoiled(folder, lambda v: v.update(format=2)), 1, "format 1, found 2"),
    "no rollouts": (lambda folder: spoiled(folder, lambda v: v.pop("rollouts")), 1, "results.json: missing or damaged"),
    "half a rollout": (
        lambda folder: spoiled(folder, lambda v: v["rollouts"][2].pop("metrics")),
        1,
        "results.json: missing or damaged: KeyError('metrics')",
    ),
    "a text for a number": (
        lambda folder: spoiled(folder, lambda v: v["reconstructions"][0].update(frames="many")),
        1,
        "results.json: missing or damaged",
    ),
    "a damaged map": (
        lambda folder: spoiled(folder, lambda v: v["rollouts"][0]["map"].update(floor="####")),
        1,
        "results.json: missing or damaged",
    ),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_input_is_one_line_that_names_it(tmp_path, capsys, fault):
    spoil, code, words = BAD[fault]
    spoil(tmp_path)
    assert command.run(main, [str(tmp_path)]) == code
    error = capsys.readouterr().err.strip()
    assert words in error
    assert len(error.splitlines()) == 1


def test_an_unknown_method_of_the_maps_gets_the_nearest_name(tmp_path, capsys):
    write_results(tmp_path, make_results(FEW, scenes=TRAIN_ONLY, starts=1), pictures=False)
    assert command.run(main, [str(tmp_path), "--maps", "heuristik"]) == 2
    assert "did you mean 'heuristic'?" in capsys.readouterr().err


def test_the_command_stands_on_its_own(tmp_path):
    line = [sys.executable, "-m", "avp_experiment.report", "--help"]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "results.json" in done.stdout


def test_a_folder_that_is_none_is_refused_by_the_function_too(tmp_path):
    with pytest.raises(UsageError, match="expected the folder of an experiment"):
        write_report(tmp_path / "none")
    (tmp_path / "results.json").mkdir()
    with pytest.raises(AVPError):
        read_results(tmp_path)


def test_geometry_after_a_part_is_not_told_of_those_alone_that_have_ended(report):
    results = make_results(("greedy", "proposed"))
    for one in results["rollouts"]:
        one["geometry_after"] = {key: value for key, value in one["geometry_after"].items() if key == "40"}
    page = (report(results) / "results.md").read_text()
    lines = page.partition("completion ratio [%], unseen scenes:")[2].splitlines()
    assert [cell.strip() for cell in lines[2].strip("|").split("|")] == ["method", "40 views", "80 views"]


def test_a_predictor_that_few_have_is_left_out_and_not_the_reconstructions(report):
    results = make_results(FEW, scenes=TRAIN_ONLY)
    for one in results["rollouts"]:
        one["geometry_after"] = None
    said = section(report(results), "What predicts PSNR")
    assert "completion ratio" not in said
    assert f" {len(results['reconstructions'])} |" in said


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
