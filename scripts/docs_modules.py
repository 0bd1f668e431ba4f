"""Hook of `mkdocs build`: the table of all modules that no other page of the reference shows."""

import ast
import re
from itertools import groupby
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("avp_habitat", "avp_sb3", "avp_nerfstudio", "avp_experiment")
PAGE = "reference/internal.md"
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


def sentence(path: Path) -> str:
    """The first paragraph of the docstring of the module in a file."""
    said = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return said.partition("\n\n")[0].replace("\n", " ").replace("|", r"\|")


def tables() -> str:
    """The modules that no page shows as Markdown: a table for each folder."""
    others = {name: path for name, path in modules().items() if name not in shown()}
    blocks = []
    for folder, names in groupby(
        sorted(others, key=lambda name: (others[name].parent, name)), lambda name: others[name].parent
    ):
        rows = [f"| `{name}` | {sentence(others[name])} |" for name in names]
        heading = f"## {folder.relative_to(ROOT)}"
        blocks.append("\n".join([heading, "", "| module | what it is |", "| --- | --- |", *rows, ""]))
    return "\n".join(blocks)


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Called by MkDocs for each page: its Markdown, with tables of internal modules, and intervals kept on one line."""
    if page.file.src_uri == PAGE:
        return markdown.replace("MODULES", tables())
    return markdown.replace(" ± ", "\u00a0±\u00a0")
