import csv
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from experiment_results import FEW, TRAIN_ONLY, by_seed, interval, make_results, write_results
from PIL import Image

from avp_experiment import plots
from avp_experiment.pictures import maps
from avp_experiment.report import main, write_report
from avp_experiment.results import read_results
from avp_habitat import command
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.metrics import Figure

ROOT = Path(__file__).resolve().parent.parent
FIGURES = ("figure3", "figure4", "figure5", "figure6", "figure6_unseen", "psnr_by_views", "budgets", "visibility")


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
