"""Names that MLflow takes for metrics, parameters, tags and pictures."""

import re

_BRACKETS, _UNSAFE = re.compile(r"[()\[\]{}]"), re.compile(r"[^\w.\- /]")
_MAX_NAME = 250


def safe_name(name: str) -> str:
    """A name that MLflow takes on every system and with every store.

    Brackets go, characters other than letters, digits, `_ . -`, space and `/` become `_`; empty and dotted path
    parts, which MLflow would resolve like a file path, go.
    """
    parts = (part.strip() for part in _UNSAFE.sub("_", _BRACKETS.sub("", name)).split("/"))
    return "/".join(part for part in parts if part not in ("", ".", ".."))[:_MAX_NAME].rstrip("/ ") or "_"
