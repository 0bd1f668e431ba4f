import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import asdict
from html.parser import HTMLParser
from math import cos, sin
from pathlib import Path

import docs_modules
import pytest
import yaml

from avp_habitat.poses import camera_to_world, y_up_to_z_up
from avp_habitat.task.observations import NAMES
from avp_habitat.task.rewards import RewardConstants
from avp_habitat.task.settings import ACTION_NAMES

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"


def pages_of(nav):
    """Paths in the order of a nav, sections opened."""
    if isinstance(nav, str):
        return [nav]
    entries = nav if isinstance(nav, list) else nav.values()
    return [page for entry in entries for page in pages_of(entry)]


def nav_faults(nav, files):
    """What a nav lists twice, leaves out or only imagines."""
    listed = Counter(pages_of(nav))
    return sorted({page for page, times in listed.items() if times > 1} | (set(listed) ^ set(files)))


def configuration():
    return yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))


def files():
    return {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}


def test_the_navigation_lists_every_page_once():
    assert nav_faults(configuration()["nav"], files()) == []


@pytest.mark.parametrize(
    ("nav", "fault"),
    [
        ([{"A": "a.md"}], "b.md"),
        ([{"A": "a.md"}, {"More": [{"B": "b.md"}, {"Again": "a.md"}]}], "a.md"),
        ([{"A": "a.md"}, {"More": ["b.md", "c.md"]}], "c.md"),
    ],
)
def test_a_wrong_navigation_would_be_found(nav, fault):
    assert nav_faults(nav, {"a.md", "b.md"}) == [fault]


def faults_of_reference(modules):
    """Modules that the reference shows more than once, or that are gone."""
    times = Counter(docs_modules.shown())
    return sorted(name for name in times if times[name] != 1 or name not in modules)


def test_the_reference_shows_no_module_twice_and_none_that_is_gone():
    assert faults_of_reference(docs_modules.modules()) == []


def test_a_module_that_is_gone_would_be_found():
    left = {name: path for name, path in docs_modules.modules().items() if name != "avp_habitat.poses"}
    assert faults_of_reference(left) == ["avp_habitat.poses"]


def test_every_other_module_stands_among_the_internal_ones():
    named = re.findall(r"^\| `([\w.]+)` \|", docs_modules.tables(), re.MULTILINE)
    assert sorted([*named, *docs_modules.shown()]) == sorted(docs_modules.modules())


def test_every_module_says_what_it_is():
    assert [name for name, path in docs_modules.modules().items() if not docs_modules.sentence(path)] == []


FORMULAS = (DOCS / "axes-and-formulas.md").read_text(encoding="utf-8")


def test_the_page_of_formulas_has_the_constants_of_the_code():
    section = FORMULAS.partition("## Rewards")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| [^|]+ \| `(\w+)` \| ([\d.]+)", section, re.MULTILINE)
    assert {name: float(value) for name, value in rows} == asdict(RewardConstants())


def test_the_page_of_formulas_has_the_actions_of_the_code():
    rows = re.findall(r"^\| ([\d, ]+) \| ((?:`\w+`(?:, )?)+) \|", FORMULAS, re.MULTILINE)
    listed = {
        int(number): name
        for numbers, names in rows
        for number, name in zip(numbers.split(", "), re.findall(r"`(\w+)`", names), strict=True)
    }
    assert listed == dict(enumerate(ACTION_NAMES))


def test_the_page_of_formulas_counts_the_observed_numbers():
    section = FORMULAS.partition("## What a policy observes")[2].partition("\n## ")[0]
    numbered = re.findall(r"^\| ([\d, ]+) \|", section, re.MULTILINE)
    counted = [int(number) for row in numbered for number in row.split(", ")]
    assert counted == list(range(1, len(NAMES) + 1))


def test_the_matrix_on_the_page_of_formulas_is_that_of_the_code():
    psi, phi = 0.7, -0.3
    (pose,) = camera_to_world([[4.0, 5.0, 6.0]], yaw=[psi], pitch=[phi])
    names = {"cos": cos, "sin": sin, "ψ": psi, "φ": phi, "x": 4.0, "y": 5.0, "z": 6.0}
    rows = re.findall("[⎡⎢⎣](.+)[⎤⎥⎦]", FORMULAS)
    assert len(rows) == 4
    for row, expected in zip(rows, pose, strict=True):
        entries = [entry.strip().replace("−", "-").replace("·", "*") for entry in re.split(r"\s{2,}", row.strip())]
        values = [eval(re.sub(r"(sin|cos) (\w)", r"\1(\2)", entry), {}, names) for entry in entries]
        assert values == pytest.approx(list(expected))


def test_nerfstudios_world_is_turned_as_the_page_of_formulas_says():
    assert "(x, y, z)  →  (x, −z, y)" in FORMULAS
    (pose,) = camera_to_world([[4.0, 5.0, 6.0]], yaw=[0.0], pitch=[0.0])
    assert list(y_up_to_z_up(pose)[:3, 3]) == [4.0, -6.0, 5.0]


class _Addresses(HTMLParser):
    """Collects what a browser fetches for a page by itself."""

    def __init__(self):
        super().__init__()
        self.fetched = []

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.fetched += [given[name] for name in ("src", "data", "poster") if given.get(name)]
        if tag == "link" and given.get("rel") not in ("canonical", "next", "prev"):
            self.fetched.append(given["href"])


def fetched_by(page):
    parser = _Addresses()
    parser.feed(page)
    return [address for address in parser.fetched if re.match(r"(?:\w+:)?//", address)]


def test_what_a_page_fetches_from_elsewhere_would_be_found():
    page = (
        '<a href="https://a.org">a</a><script src="//b.org/x.js"></script><link rel="stylesheet" href="https://c.org">'
    )
    assert fetched_by(page) == ["//b.org/x.js", "https://c.org"]


def build(folder, into):
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(into)]
    env = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
def test_the_pages_build_without_warnings_and_fetch_nothing_from_elsewhere(tmp_path):
    done = build(ROOT, tmp_path / "site")
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > len(files())
    assert {address for page in pages for address in fetched_by(page.read_text(encoding="utf-8"))} == set()
    styles = [path.read_text(encoding="utf-8") for path in (tmp_path / "site").rglob("*.css")]
    assert not any(re.search(r"(?:url\(|@import)\s*[\"']?(?:https?:)?//", style) for style in styles)
    reference = (tmp_path / "site/reference/maths.html").read_text(encoding="utf-8")
    assert 'id="avp_habitat.poses.camera_to_world"' in reference
    assert "greedy set cover" in (tmp_path / "site/reference/internal.html").read_text(encoding="utf-8").lower()


@pytest.mark.slow
def test_a_docstring_that_names_a_parameter_that_is_not_there_ends_the_build(tmp_path):
    for name in ("docs", *docs_modules.PACKAGES, "scripts"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("mkdocs.yml", "CONTRIBUTING.md"):
        shutil.copy(ROOT / name, tmp_path)
    source = tmp_path / "avp_habitat/metrics.py"
    with source.open("a", encoding="utf-8") as file:
        file.write(
            '\n\ndef added(images: int) -> int:\n    """Something.\n\n    Args:\n        pictures: one.\n    """\n'
        )
    done = build(tmp_path, tmp_path / "site")
    assert done.returncode != 0
    assert "'pictures' does not appear in the function signature" in done.stderr
