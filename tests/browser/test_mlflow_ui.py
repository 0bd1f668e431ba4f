"""MLflow's own page, seen by a real browser that has never been there: what the suite logs answers the question."""

import json
import os
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import quote

import pytest

pytest.importorskip("nerfstudio")

from mlflow import MlflowClient
from mlflow_page import mlflow_server, opened
from nerfstudio_training import tiny_config, train
from PIL import Image

import avp_nerfstudio.log
import avp_sb3.evaluate
from avp_habitat import command
from avp_habitat.collect import Collect, collect
from avp_habitat.task.settings import TaskSettings
from avp_habitat.tracking import compare
from avp_habitat.tracking.view import EVALUATIONS, path_of

pytestmark = [pytest.mark.browser, pytest.mark.slow]

BUDGETS = {"heuristic": 8, "spin": 6, "greedy": 10}
FIGURES = ("eval/coverage", "eval/views", "eval/psnr")


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Three policies' rollouts, each reconstructed for a moment, and an evaluation of two, by the suite's commands."""
    folder = tmp_path_factory.mktemp("mlflow")
    address = f"sqlite:///{folder}/mlflow.db"
    quiet = {"MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_TRACKING_URI": address, "https_proxy": "http://127.0.0.1:9"}
    weights = Path(__file__).resolve().parents[3] / "shared/torch_home"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, value in (quiet | {"TORCH_HOME": str(weights if weights.is_dir() else folder)}).items():
            patch.setenv(name, value)
        for policy in BUDGETS:
            reconstruct(policy, folder)
        words = ["--scene", "builtin:0", "--policy", "spin", "--policy", "heuristic", "--episodes", "2"]
        size = ["--budget", "6", "--width", "16", "--height", "12"]
        assert command.run(avp_sb3.evaluate.main, [*words, *size, "--out", "report"]) == 0
        assert command.run(compare.main, []) == 0
        client = MlflowClient(address)
        experiment = client.get_experiment_by_name("avp").experiment_id
        runs = client.search_runs([experiment])
        yield SimpleNamespace(client=client, experiment=experiment, runs=runs, address=address, folder=folder)


def reconstruct(policy, folder):
    settings = TaskSettings(budget=BUDGETS[policy], width=32, height=24)
    rollout = folder / policy
    collect(Collect(scene="builtin:0", policy=policy, out=rollout, width=48, height=36), settings=settings, heldout=2)
    config = tiny_config(rollout, folder / "nerf", iterations=12)
    config.experiment_name = policy
    assert command.run(avp_nerfstudio.log.main, [os.fspath(train(config)), "--pictures", "1"]) == 0


@pytest.fixture(scope="module")
def server(store):
    with mlflow_server(store.address, store.folder / "server") as address:
        yield address


@pytest.fixture(scope="module")
def reconstructions(store):
    """The three runs by policy."""
    found = {run.data.tags["avp.policy"]: run for run in store.runs if "eval/psnr" in run.data.metrics}
    assert found.keys() == BUDGETS.keys()
    for policy, run in found.items():
        meta = json.loads((store.folder / policy / "rollout.json").read_text())
        assert run.data.metrics["eval/coverage"] == meta["metrics"]["coverage"]
        assert run.data.metrics["eval/views"] == meta["metrics"]["views"] == BUDGETS[policy]
    return found


def rows_of(page, columns):
    """The table's rows as the page shows them, by run name, which is in a part of the table that does not scroll."""
    page.wait_for_selector(f'.ag-center-cols-container [col-id="{columns[0]}"]')
    return page.evaluate(
        """columns => {
            const rows = {};
            for (const row of document.querySelectorAll(".ag-row")) {
                const shown = rows[row.getAttribute("row-index")] ??= {};
                for (const cell of row.querySelectorAll("[col-id]"))
                    shown[cell.getAttribute("col-id")] = cell.innerText.trim();
            }
            return Object.values(rows);
        }""",
        columns,
    )


def assert_shown(text, value):
    """The page rounds some values; what it shows is right to its last digit."""
    digits = len(text.partition(".")[2])
    assert float(text) == pytest.approx(value, abs=0.5001 * 10.0**-digits, rel=1e-12)


def test_the_runs_page_shows_three_reconstructions_with_their_figures_the_best_first(
    browser, server, store, reconstructions
):
    with opened(browser, server, path_of(store.experiment)) as page:
        shown = rows_of(page, [f"metrics.`{name}`" for name in FIGURES])
        headers = page.locator(".ag-header-cell").all_inner_texts()
    assert [row["tags.`avp.policy`"] for row in shown] == sorted(
        reconstructions, key=lambda policy: -reconstructions[policy].data.metrics["eval/psnr"]
    )
    for row in shown:
        run = reconstructions[row["tags.`avp.policy`"]]
        for name in FIGURES:
            assert_shown(row[f"metrics.`{name}`"], run.data.metrics[name])
    assert {*FIGURES, "avp.policy", "avp.scene"} <= {header.strip() for header in headers}


def test_the_charts_line_up_the_reconstructions(browser, server, store, reconstructions):
    with opened(browser, server, path_of(store.experiment, charts=True)) as page:
        page.wait_for_selector(".js-plotly-plot .scatterlayer .point")
        found = page.evaluate(
            """() => [...document.querySelectorAll(".js-plotly-plot")].map(plot => ({
                x: plot.layout.xaxis?.title?.text, y: plot.layout.yaxis?.title?.text,
                points: plot.data.map(trace => [[...trace.x ?? []], [...trace.y ?? []]]),
            }))"""
        )
    (chart,) = (one for one in found if (one["x"], one["y"]) == ("eval/views", "eval/psnr"))
    ((views, psnr),) = chart["points"]
    expected = [
        tuple(run.data.metrics[name] for name in ("eval/views", "eval/psnr")) for run in reconstructions.values()
    ]
    assert sorted(zip(views, psnr, strict=True)) == sorted(expected)


def compared_metrics(page):
    """Texts of the compare page's metrics by name, one per run: two grids that draw only the rows in sight."""
    page.wait_for_selector(".ReactVirtualized__Grid")
    return page.evaluate(
        """async () => {
            const cells = grid => [...grid.querySelector(".ReactVirtualized__Grid__innerScrollContainer").children]
                .map(one => [parseFloat(one.style.top), parseFloat(one.style.left), one.innerText.trim()]);
            const [names, values] = document.querySelectorAll(".ReactVirtualized__Grid");
            const rows = {}, found = {};
            for (let top = 0; top <= values.scrollHeight; top += 100) {
                values.scrollTop = top;
                await new Promise(done => setTimeout(done, 100));
                for (const [y, , text] of cells(names)) rows[y] = text;
                for (const [y, x, text] of cells(values)) (found[y] ??= {})[x] = text;
            }
            return Object.fromEntries(Object.entries(rows).map(([y, name]) =>
                [name, Object.entries(found[y] ?? {}).sort((a, b) => a[0] - b[0]).map(([, text]) => text)]));
        }"""
    )


def test_the_compare_page_shows_the_figures_of_three_runs(browser, server, store, reconstructions):
    ids = {run.info.run_id: run for run in reconstructions.values()}
    words = f"runs={quote(json.dumps(list(ids)))}&experiments={quote(json.dumps([store.experiment]))}"
    with opened(browser, server, f"#/compare-runs?{words}") as page:
        shown = compared_metrics(page)
        order = page.locator("tr", has_text="Run ID:").locator("th, td").all_inner_texts()[1:]
    assert set(order) == set(ids)
    for name in FIGURES:
        assert len(shown[name]) == 3
        for run_id, text in zip(order, shown[name], strict=True):
            assert_shown(text, ids[run_id].data.metrics[name])


def seen_pictures(page, count, size=None):
    """Wait until the browser shows so many pictures, decoded, of more than an icon's size or of exactly this one."""
    page.wait_for_function(
        """([count, size]) => [...document.querySelectorAll("img")].filter(one => one.complete && one.clientWidth > 50
            && (size ? one.naturalWidth == size[0] && one.naturalHeight == size[1] : one.naturalWidth > 100)
        ).length >= count""",
        arg=[count, size],
    )


def test_the_pictures_of_an_evaluation_are_seen(browser, server, store):
    with opened(browser, server, path_of(store.experiment, EVALUATIONS, charts=True)) as page:
        page.wait_for_selector(".js-plotly-plot .scatterlayer .lines")
        seen_pictures(page, 2)
    (run,) = (run for run in store.runs if run.info.run_name == "evaluation")
    path = f"#/experiments/{store.experiment}/runs/{run.info.run_id}/artifacts/coverage.png"
    with Image.open(store.folder / "report" / "coverage.png") as plot, opened(browser, server, path) as page:
        seen_pictures(page, 1, plot.size)


def test_the_pictures_of_a_reconstruction_are_seen(browser, server, store, reconstructions):
    run = reconstructions["greedy"].info.run_id
    (picture,) = (file for file in store.client.list_artifacts(run, "heldout") if file.path.endswith(".png"))
    path = f"#/experiments/{store.experiment}/runs/{run}/artifacts/{picture.path}"
    held = Path(store.client.download_artifacts(run, picture.path, os.fspath(store.folder)))
    with Image.open(held) as shown, opened(browser, server, path) as page:
        assert shown.width == 3 * 48
        seen_pictures(page, 1, shown.size)


def test_the_comparison_is_a_table_on_the_page(browser, server, store):
    (run,) = (run for run in store.runs if run.data.tags.get("avp.kind") == "comparison")
    methods = compare.compare(store.client, store.experiment)
    assert len(methods) == 5
    page_of_run = f"#/experiments/{store.experiment}/runs/{run.info.run_id}"
    with opened(browser, server, page_of_run) as page:
        page.locator("table", has_text="PSNR [dB]").first.wait_for()
        described = page.locator("table", has_text="PSNR [dB]").first.evaluate(
            "table => [...table.rows].map(row => [...row.cells].map(cell => cell.innerText.trim()))"
        )
    head, cells = compare.rows(methods)
    assert described == [head, *cells]
    assert all(cell in compare.markdown(methods) for row in described for cell in row)
    with opened(browser, server, f"{page_of_run}/artifacts/comparison.json") as page:
        page.get_by_text("avp-nerfacto").first.wait_for()
        for method in methods:
            assert page.get_by_text(method.policy, exact=True).first.is_visible()
