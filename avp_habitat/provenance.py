"""What made a result: versions, commit, and whether this machine has a GPU."""

import ctypes
import platform
import subprocess
from collections.abc import Iterable, Mapping
from importlib import metadata
from typing import Any

_HOSTS = ("stable-baselines3", "nerfstudio", "torch", "gymnasium", "numpy", "open3d", "mlflow", "rerun-sdk")
PACKAGES = ("avp-suite", *_HOSTS)
"""The suite, and what its results depend on most."""


def git_commit() -> str | None:
    """The commit checked out in the current folder; None outside a repository or without git."""
    try:
        return subprocess.check_output(["git", "rev-parse", "HEAD"], text=True, stderr=subprocess.DEVNULL).strip()
    except (OSError, subprocess.SubprocessError):
        return None


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


WITHOUT_GPU = "--machine.device-type cpu --pipeline.model.implementation torch --mixed-precision False"
"""Options with which nerfstudio's own methods run on a CPU; `avp-nerfacto` chooses by itself."""


def has_cuda() -> bool:
    """Whether torch, as it is installed, would find a CUDA device: asks NVIDIA's driver, in milliseconds."""
    if (version_of("torch") or "").endswith("+cpu"):
        return False
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        count = ctypes.c_int(0)
        return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0
    except (OSError, AttributeError):
        return False


def nerfacto_line(data: str) -> str:
    """The command line that trains plain nerfacto on a rollout, quoted for a shell, on this machine."""
    options = "" if has_cuda() else f"{WITHOUT_GPU} "
    return f"ns-train nerfacto {options}avp-data --data {data}"
