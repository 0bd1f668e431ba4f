"""Versions of Python and of installed packages, for whoever has to say what made a result."""

import platform
import subprocess
from collections.abc import Iterable, Mapping
from importlib import metadata
from typing import Any

PACKAGES = (
    "avp-suite",
    "stable-baselines3",
    "nerfstudio",
    "torch",
    "gymnasium",
    "numpy",
    "open3d",
    "mlflow",
    "rerun-sdk",
)
"""The suite, and what its results depend on most."""


def git_commit() -> str | None:
    """The commit checked out in the current folder; None outside a repository or without git."""
    command = ["git", "rev-parse", "HEAD"]
    try:
        answer = subprocess.run(
            command, capture_output=True, text=True, timeout=10, check=True, stdin=subprocess.DEVNULL
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one, keys joined by dots."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flat(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value
    return leaves


def installed_versions(packages: Iterable[str]) -> dict[str, str]:
    """Version by name, of `python` first and then of those of the packages that are installed."""
    found = {"python": platform.python_version()}
    return found | {package: version for package in packages if (version := version_of(package)) is not None}


def version_of(distribution: str) -> str | None:
    """Installed version of a distribution; None when it is not installed."""
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return None
