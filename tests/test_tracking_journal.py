import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from avp_habitat.tracking import journal as module
from avp_habitat.tracking.journal import VERSION, Journal
from avp_habitat.tracking.stores import TrackingError

HEADER = {
    "version": VERSION,
    "key": "k1",
    "address": "sqlite:///x.db",
    "run_id": None,
    "owned": True,
    "ended": None,
    "started_ms": 1,
}


@pytest.fixture(autouse=True)
def spool(tmp_path, monkeypatch):
    monkeypatch.setenv("AVP_MLFLOW_SPOOL", str(tmp_path))


@pytest.fixture
def journal():
    made = Journal.create(HEADER)
    yield made
    made.release()


def drained(journal):
    entries = []
    while batch := journal.read():
        entries += batch
        journal.acknowledge()
    return entries


def test_entries_come_back_in_order_and_once(journal):
    entries = [{"metrics": [["a", i, 0, i]]} for i in range(5)]
    for entry in entries[:3]:
        journal.append(entry)
    assert drained(journal) == entries[:3]
    for entry in entries[3:]:
        journal.append(entry)
    assert drained(journal) == entries[3:]
    assert journal.read() == []
    assert not journal.pending


def test_what_was_not_acknowledged_comes_again_also_to_the_next_process(tmp_path):
    first = Journal.create(HEADER)
    for i in range(3):
        first.append({"tags": {"n": str(i)}})
    first.read()
    first.acknowledge()
    first.append({"tags": {"n": "3"}})
    assert first.read() == first.read() == [{"tags": {"n": "3"}}]
    first.release()
    second = Journal.adopt(tmp_path / "k1")
    assert second.header == HEADER
    assert drained(second) == [{"tags": {"n": "3"}}]
    second.remove()
    assert not (tmp_path / "k1").exists()


def test_a_line_that_a_power_cut_cut_off_or_damaged_is_dropped(tmp_path):
    first = Journal.create(HEADER)
    first.append({"tags": {"n": "0"}})
    first.release()
    file = tmp_path / "k1" / "journal.jsonl"
    file.write_bytes(file.read_bytes() + b'\xff{"tags"\n' + b'{"tags": {"n": "lo')
    second = Journal.adopt(tmp_path / "k1")
    second.append({"tags": {"n": "1"}})
    assert [entry["tags"] for entry in drained(second)] == [{"n": "0"}, {"n": "1"}]
    second.release()


def test_a_long_journal_is_read_in_parts_and_gives_its_space_back(journal, monkeypatch):
    monkeypatch.setattr(module, "_CHUNK", 1000)
    monkeypatch.setattr(module, "_COMPACT", 2000)
    entries = [{"tags": {"text": "x" * (700 * (i % 4) + 1), "n": str(i)}} for i in range(20)]
    for entry in entries:
        journal.append(entry)
    assert len(journal.read()) < 20
    assert drained(journal) == entries
    assert (journal.folder / "journal.jsonl").stat().st_size == 0
    journal.append({"tags": {"n": "after"}})
    assert drained(journal) == [{"tags": {"n": "after"}}]


def test_a_journal_in_use_is_nobody_elses(journal, tmp_path):
    assert Journal.adopt(tmp_path / "k1") is None
    code = f"""
import sys
from pathlib import Path
from avp_habitat.tracking.journal import Journal
sys.exit(Journal.adopt(Path({str(tmp_path / "k1")!r})) is not None)
"""
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
    # Looking at it must not have opened the lock for others.
    assert Journal.adopt(tmp_path / "k1") is None
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_a_folder_that_is_no_journal_is_left_alone(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "run.json").write_text(json.dumps(HEADER | {"version": 0}))
    assert Journal.adopt(tmp_path / "photos") is None
    assert Journal.adopt(tmp_path / "old") is None
    assert list((tmp_path / "photos").iterdir()) == []


def test_a_folder_that_takes_no_journal_is_an_error_that_names_the_way_out(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("AVP_MLFLOW_SPOOL", str(tmp_path / "file"))
    with pytest.raises(TrackingError, match=r"file/k1: cannot be written: Not a directory; .* in AVP_MLFLOW_SPOOL$"):
        Journal.create(HEADER)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


# A limit on the size of files, which stands for a full disk, holds for a whole process.
FULL = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from test_tracking_journal import HEADER, drained
from avp_habitat.tracking.journal import Journal

journal = Journal.create(HEADER)
soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
entries = [{"tags": {"n": str(i), "text": "x" * 200}} for i in range(30)]
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
for entry in entries[:20]:
    journal.append(entry)
assert "k1: " in journal.problem, journal.problem
first = journal.read()
journal.acknowledge()
on_the_way = journal.read()
resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
for entry in entries[20:]:
    journal.append(entry)
journal.acknowledge()
rest = drained(journal)
assert first + on_the_way + rest == entries
assert len(first) in (3, 4) and rest == entries[20:], (len(first), len(rest))
assert journal.problem is None
"""


def test_a_full_disk_costs_nothing_while_the_process_lives():
    done = subprocess.run(
        [sys.executable, "-c", FULL, Path(__file__).parent], capture_output=True, text=True, cwd=os.getcwd()
    )
    assert done.returncode == 0, done.stderr
