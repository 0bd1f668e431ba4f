"""The weights that lie in this package, and where a policy's files are by the name that a user gives."""

import os
from pathlib import Path
from typing import Any

from avp_habitat.errors import PolicyError, UsageError, unknown_name

PRETRAINED = "pretrained"
"""The name of the default weights of the package; `pretrained:NAME` are others of it."""
DEFAULT = "multiview"
"""Which of the package's weights `pretrained` stands for."""
FOLDER = Path(__file__).parent
"""Where the package's weights lie."""


def available() -> dict[str, Path]:
    """The package's weights: the path of the `.json` by name."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.json"))}


def packaged(name: str) -> Path:
    """The `.json` of weights of the package.

    Raises:
        UsageError: the package has no weights of that name; the nearest is named.
    """
    there = available()
    if not there:
        raise UsageError(f"pretrained weights {name!r}: this copy of avp-suite has none; give the folder of a policy")
    if name not in there:
        raise unknown_name("pretrained weights", name, there)
    return there[name]


def weights_file(policy: Any) -> Path | None:
    """The `.json` of a policy given as `pretrained`, `pretrained:NAME`, its folder or that file; None for other texts.

    Raises:
        UsageError: there are no such weights, file or folder.
        PolicyError: the folder holds no policy, or several.
    """
    if not isinstance(policy, str):
        return None
    kind, _, name = policy.partition(":")
    if kind == PRETRAINED:
        return packaged(name or DEFAULT)
    path = Path(policy)
    if path.is_dir():
        return _only_one(path)
    if not policy.endswith(".json") and (os.sep not in policy or ":" in policy or policy.endswith(".zip")):
        return None
    if not path.is_file():
        raise UsageError(f"policy {policy}: no such file or folder")
    return path


def _only_one(folder: Path) -> Path:
    found = sorted(path for path in folder.glob("*.json") if path.with_suffix(".safetensors").is_file())
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise PolicyError(f"policy {folder}: expected one NAME.json with its NAME.safetensors there, found {names}")
    return found[0]
