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


class Names:
    """The safe names of one run: each name has its own, also when two differ only in what MLflow refuses."""

    def __init__(self) -> None:
        """Begin without any."""
        self._safe: dict[str, str] = {}
        self._taken: set[str] = set()

    def __getitem__(self, name: str) -> str:
        """The safe name."""
        if name not in self._safe:
            self._safe[name] = self._free(safe_name(name))
            self._taken.add(self._safe[name])
        return self._safe[name]

    @property
    def changed(self) -> dict[str, str]:
        """Safe names by the names that MLflow refuses."""
        return {name: safe for name, safe in self._safe.items() if name != safe}

    def _free(self, name: str) -> str:
        candidate, count = name, 1
        while candidate in self._taken:
            count += 1
            candidate = f"{name[: _MAX_NAME - 4]} {count}"
        return candidate
