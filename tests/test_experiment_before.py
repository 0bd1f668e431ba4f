"""An experiment's folder of before the packages' layout changed (tests/data/before) still opens."""

import json
import re
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest

from avp_experiment import compare, report
from avp_experiment.cells import TRAIN, plan
from avp_experiment.configuration import PRESETS
from avp_experiment.folder import open_folder
from avp_experiment.gathering import gather
from avp_habitat import command

SAMPLE = Path(__file__).resolve().parent / "data" / "before" / "experiment.tar.xz"


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    folder = tmp_path_factory.mktemp("before")
    with tarfile.open(SAMPLE) as archive:
        archive.extractall(folder, filter="data")
    return folder / "experiment"


def without_column(page, title):
    """A page without the column of that title in its tables, Markdown's or CSV."""
    lines, left_out = [], None
    for line in page.splitlines():
        mark = "|" if line.startswith("|") else ","
        cells = line.split(mark)
        if any(title in cell for cell in cells) and len(cells) > 5:
            left_out = [i for i, cell in enumerate(cells) if title in cell]
        elif len(cells) <= 5:
            left_out = None
        lines.append(mark.join(cell for i, cell in enumerate(cells) if i not in (left_out or ())))
    return "\n".join(lines)


def words_of(page):
    """A page without what the new layout says in other words, and the column and tables that there are since."""
    page = re.sub(r"- Table \d, geometry: .*\n", "", page)
    page = (
        without_column(page, "parallax")
        .replace("path [m]", "path length [m]")
        .replace("python -m experiment", "python -m avp_experiment")
    )
    return re.sub(r"[ -]+", " ", page)


def figures_of(page):
    """The lines of tables and sentences that hold a figure; where they come from is said elsewhere since."""
    page = re.sub(r"Over all reconstructions visibility and PSNR have (ρ[^]]*]).*", r"\1", page)
    lines = [line for line in page.splitlines() if not line.startswith(("- ", "All "))]
    return [line for line in lines if re.search(r"\d [|%]|\d ± |ρ = ", line)]


def test_its_tables_claims_and_page_are_what_they_were(before, tmp_path):
    folder = shutil.copytree(before, tmp_path / "e")
    assert command.run(report.main, [str(folder)]) == 0
    for name in ("table2.md", "table2.csv"):
        assert words_of((folder / name).read_text()) == words_of((before / name).read_text()), name
    for name in ("claims.md", "results.md"):
        said = words_of((folder / name).read_text())
        for line in figures_of(words_of((before / name).read_text())):
            assert line in said, name


def what_was(found, known):
    """Entries without what is measured only since."""
    if not isinstance(found, list) or len(found) != len(known) or not isinstance(known[0] if known else None, dict):
        return found
    return [{name: one[name] for name in one if name in old} for one, old in zip(found, known, strict=True)]


def test_nothing_of_it_is_done_again_and_the_same_results_are_gathered(before, tmp_path, monkeypatch):
    folder = shutil.copytree(before, tmp_path / "e")
    small = {"steps": 6144, "size": (32, 24), "iterations": 10, "budget": 6, "prefixes": (3,), "heldout_pictures": (3,)}
    monkeypatch.setitem(PRESETS, "smoke", replace(PRESETS["smoke"], **small))
    options = compare.Compare(preset="smoke", unseen="none", methods="heuristic,proposed")
    configuration = options.configuration()
    kept = open_folder(configuration, folder)
    cells = plan(configuration, folder, tracking="avp")
    assert [cell.kind for cell in cells].count(TRAIN) == 1
    assert all(kept.is_done(cell) for cell in cells)
    known, found = (
        json.loads((before / "results.json").read_text()),
        gather(configuration, kept, cells, command="again"),
    )
    for part in ("configuration", "methods", "training", "rollouts", "reconstructions", "failed"):
        assert what_was(json.loads(json.dumps(found[part])), known[part]) == known[part], part
