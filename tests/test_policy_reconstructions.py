import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("nerfstudio")

from avp_habitat.errors import UsageError

SCRIPTS = Path(__file__).resolve().parent.parent / "scripts"


@pytest.fixture
def script(monkeypatch):
    monkeypatch.syspath_prepend(SCRIPTS)
    import policy_reconstructions

    yield policy_reconstructions
    del sys.modules["policy_reconstructions"]


def test_policies_whose_folders_would_have_one_name_are_refused(script):
    with pytest.raises(UsageError, match="policy: expected names that differ without folder and ending, got a/best"):
        script.PolicyReconstructions(("builtin:3",), ("a/best.zip", "b/best.zip"))


@pytest.mark.slow
def test_policies_are_compared_at_equal_views_and_what_is_done_is_kept(script, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    options = script.PolicyReconstructions(
        ("builtin:3",),
        ("heuristic", "random"),
        starts=1,
        depth=(False,),
        iterations=2,
        width=40,
        folder=tmp_path / "made",
        out=tmp_path / "out.json",
    )
    script.main(options)
    entries = json.loads(options.out.read_text())["reconstructions"]
    assert [entry["policy"] for entry in entries] == ["heuristic", "random"]
    assert len({entry["views"] for entry in entries}) == 1
    assert entries[0]["views"] == min(entry["episode"] for entry in entries)
    assert entries[0]["visibility"] != entries[1]["visibility"]
    before = sorted((path, path.stat().st_mtime_ns) for path in options.folder.iterdir())
    script.main(options)
    assert sorted((path, path.stat().st_mtime_ns) for path in options.folder.iterdir()) == before
    assert capsys.readouterr().out.count("| builtin:3 |") == 4
