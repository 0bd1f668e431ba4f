"""The shape of the house: how long modules are, how full folders are, and which way imports point."""

import ast
from collections import Counter, defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("avp_habitat", "avp_sb3", "avp_nerfstudio", "avp_experiment")
LONGEST, FULLEST = 350, 15
CORE = ("task", "sight", "surface", "rollout", "policies", "simulators", "navigation", "scenes")
"""Folders of avp_habitat that know no tracker."""


def modules():
    """Source texts by dotted name; a package has that of its `__init__.py`."""
    found = {}
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_text(encoding="utf-8")
    return found


def imported_by(source, known):
    """Modules of the suite that a source text imports, also late, but not for type checkers alone."""
    names = set()
    for node in _nodes(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            whole = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name if name in known else node.module for name in whole}
    return names & known


def _nodes(node):
    yield node
    if not (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)):
        for child in ast.iter_child_nodes(node):
            yield from _nodes(child)


def cycles(imports):
    """Groups of modules each of which reaches every other one by imports."""
    reached = {}
    for start in imports:
        seen, waiting = set(), [start]
        while waiting:
            new = imports[waiting.pop()] - seen
            seen |= new
            waiting += new
        reached[start] = seen
    loops = {frozenset(b for b in reached[a] if a in reached[b]) for a in imports if a in reached[a]}
    return sorted(map(sorted, loops))


def all_imports():
    sources = modules()
    return {name: imported_by(source, set(sources)) - {name} for name, source in sources.items()}


def test_no_module_is_long():
    lengths = {name: source.count("\n") for name, source in modules().items()}
    assert {name: length for name, length in lengths.items() if length > LONGEST} == {}


def test_no_folder_is_crowded():
    files = Counter(
        str(path.parent.relative_to(ROOT)) for package in PACKAGES for path in (ROOT / package).rglob("*.py")
    )
    assert {folder: count for folder, count in files.items() if count > FULLEST} == {}


def test_imports_form_no_cycle():
    assert cycles(all_imports()) == []


@pytest.mark.parametrize("source", ["import a.b", "def late():\n    from a.b import thing", "from a import b"])
def test_a_cycle_would_be_found(source):
    imports = {"a.b": imported_by("from a.c import thing", {"a.b", "a.c"}), "a.c": imported_by(source, {"a.b", "a.c"})}
    assert cycles(imports) == [["a.b", "a.c"]]


def test_no_class_name_stands_twice():
    found = defaultdict(list)
    for name, source in modules().items():
        for node in ast.parse(source).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(name)
    assert {name: places for name, places in found.items() if len(places) > 1} == {}


def test_the_core_knows_no_tracker():
    tracking = {"avp_habitat.tracking"}
    wrong = [
        (name, target)
        for name, targets in all_imports().items()
        for target in targets
        if name.split(".")[:2] in [["avp_habitat", folder] for folder in CORE] and target.startswith(tuple(tracking))
    ]
    assert wrong == []
