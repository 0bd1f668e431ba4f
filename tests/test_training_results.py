"""The tables of docs/results/training are what the script makes of what is stored beside them."""

import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
STORED = ROOT / "docs" / "results" / "training"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    import training_results

    yield training_results
    del sys.modules["training_results"]


def cells_of(page):
    """Lines of tables without their titles, in an order of their own, as the tables' order is not the script's."""
    lines = [line for line in page.read_text(encoding="utf-8").splitlines() if "±" in line]
    return sorted(sorted(cell.strip() for cell in line.split("|")[2:]) for line in lines)


def test_tables_are_made_from_what_is_stored(script, tmp_path):
    folder = shutil.copytree(STORED, tmp_path / "training")
    made = [folder / name for name in ("README.md", "white_room/table.md", "grey_white_room/table.md")]
    before = [cells_of(path) for path in made]
    for path in made:
        path.unlink()
    script.write_tables(folder, ["white_room.glb", "grey_white_room.glb"])
    assert [cells_of(path) for path in made] == before
    assert len(before[0]) > 20


def test_another_stored_number_is_another_number_in_the_table(script, tmp_path):
    folder = shutil.copytree(STORED, tmp_path / "training")
    table = folder / "white_room" / "table.md"
    script.write_tables(folder, ["white_room.glb", "grey_white_room.glb"])
    before = cells_of(table)
    stored = folder / "white_room" / "episodes.csv"
    stored.write_text(stored.read_text().replace("heuristic,1000,0.161845478", "heuristic,1000,0.961845478"))
    script.write_tables(folder, ["white_room.glb", "grey_white_room.glb"])
    assert sum(row not in before for row in cells_of(table)) == 1
