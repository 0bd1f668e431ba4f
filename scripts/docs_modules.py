"""Hook of `mkdocs build`: what pages need beyond their Markdown, above all the internal modules as tables.

A line `- avp_sb3.rerun_*` of docs/reference/internal.md stands for all modules of that name that no other page of the
reference shows.
"""

import ast
import re
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("avp_habitat", "avp_sb3", "avp_nerfstudio")
PAGE = "reference/internal.md"
_ITEM = re.compile(r"^- (avp_[\w.*]+)$", re.MULTILINE)
_ITEMS = re.compile(r"(?:^- avp_[\w.*]+\n?)+", re.MULTILINE)
_SHOWN = re.compile(r"^::: (avp_[\w.]+)$", re.MULTILINE)


def modules() -> dict[str, Path]:
    """Every module of the suite's packages by its dotted name; a package has that of its `__init__.py`."""
    found = {}
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            parts = path.relative_to(ROOT).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def shown() -> list[str]:
    """The modules that the pages of the reference show, with repetitions if there are any."""
    pages = sorted((ROOT / "docs/reference").glob("*.md"))
    return [name for page in pages for name in _SHOWN.findall(page.read_text(encoding="utf-8"))]


def internal(markdown: str) -> list[str]:
    """The modules that the list items of a text stand for, in their order.

    Raises:
        ValueError: an item stands for no module.
    """
    names = []
    others = [name for name in modules() if name not in shown()]
    for pattern in _ITEM.findall(markdown):
        meant = [name for name in others if fnmatchcase(name, pattern)]
        if not meant:
            raise ValueError(f"docs/{PAGE}: {pattern} is no module that other pages leave out; was it renamed?")
        names += meant
    return names


def sentence(path: Path) -> str:
    """The first line of the docstring of the module in a file."""
    said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return said.partition("\n")[0].replace("|", r"\|")


def table(markdown: str) -> str:
    """The modules of some list items, one row each, as Markdown."""
    known = modules()
    rows = [f"| `{name}` | {sentence(known[name])} |" for name in internal(markdown)]
    return "\n".join(["| module | what it is |", "| --- | --- |", *rows, ""])


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for each page: its Markdown, with tables of internal modules, and intervals kept on one line."""
    if page.file.src_uri == PAGE:
        return _ITEMS.sub(lambda items: table(items.group()), markdown)
    return markdown.replace(" ± ", "\u00a0±\u00a0")
