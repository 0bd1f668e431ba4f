"""Versions of Python and of installed packages, for whoever has to say what made a result."""

import platform
from collections.abc import Iterable
from importlib import metadata

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
