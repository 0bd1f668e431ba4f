"""The manifest of plugs and the suite's own requirements, from wherever the suite is installed."""

import tomllib
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement

from avp_habitat.errors import AVPError

DISTRIBUTION = "avp-suite"
NAME = "plugins.toml"
_USER_EXTRAS = ("sb3", "nerfstudio")


@dataclass(frozen=True)
class Plug:
    """One entry of `plugins.toml`."""

    host: str
    """The program or library that loads it."""
    group: str
    """Where the host looks for it: an entry-point group, a kind of class, or the path."""
    name: str
    """What users type."""
    object: str
    """`module:name` behind it."""
    shows: str
    """A command that shows it working."""


def manifest_path() -> Path:
    """Path of `plugins.toml`: beside the packages in a checkout, else where the wheel put it.

    Raises:
        AVPError: it is at neither place.
    """
    folders = Path(__file__).resolve().parents
    candidates = [folders[2] / NAME, *(folder / "share" / DISTRIBUTION / NAME for folder in folders)]
    for path in candidates:
        if path.is_file():
            return path
    raise AVPError(f"{candidates[0]}: the manifest of plugs is missing; reinstall the suite")


def read_manifest() -> list[Plug]:
    """Every plug of the manifest, in its order."""
    entries = tomllib.loads(manifest_path().read_text(encoding="utf-8"))["plugin"]
    return [Plug(**entry) for entry in entries]


def requirements() -> dict[str | None, list[Requirement]] | None:
    """What the installed suite asks for, by extra (None: always); None when the suite is not installed."""
    try:
        lines = metadata.requires(DISTRIBUTION) or []
    except metadata.PackageNotFoundError:
        return None
    asked: dict[str | None, list[Requirement]] = {None: [], **{extra: [] for extra in _USER_EXTRAS}}
    for requirement in map(Requirement, lines):
        marker = requirement.marker
        if marker is None or marker.evaluate({"extra": ""}):
            asked[None].append(requirement)
            continue
        for extra in _USER_EXTRAS:
            if marker.evaluate({"extra": extra}):
                asked[extra].append(requirement)
    return asked
