"""Whether Habitat-Sim is installed and fits this Python, found out without importing it."""

import importlib.util
import re
from dataclasses import dataclass
from pathlib import Path

from avp_habitat.errors import SimulatorError
from avp_habitat.provenance import version_of

HOW_TO_GET = (
    "habitat-sim is not installed, and the package index has none; build version 0.3.4 from its sources "
    "(github.com/facebookresearch/habitat-sim, BUILD_FROM_SOURCE.md): conda's packages were reported to be for Python "
    "3.9 only (its issue 2625); or use --simulator raycast, which needs nothing"
)
# Earlier ones carry pybind11 2.10 and 2.11, which read NumPy 1's structures: with NumPy 2 such a module loads without a
# word and then hands out wrong arrays (tried with pybind11 2.11.1 and NumPy 2.3.5: element size 0).
_FIRST_FOR_NUMPY_2 = (0, 3, 4)


@dataclass(frozen=True)
class HabitatInstallation:
    """What is known of Habitat-Sim before it is imported."""

    installed: bool
    """Whether Python would find the package."""
    version: str | None = None
    """Release number, for example `"0.3.4"`; None where nothing tells it."""


def inspect_installation() -> HabitatInstallation:
    """Look for Habitat-Sim; imports nothing of it."""
    spec = importlib.util.find_spec("habitat_sim")
    # A folder of that name without code is a checkout's or a data folder on the path, not the package.
    if spec is None or spec.origin is None:
        return HabitatInstallation(False)
    written = re.search(r'__version__ = "([^"]+)"', Path(spec.origin).read_text(encoding="utf-8"))
    version = written and written[1]
    # The sources tagged v0.3.4 still call themselves 0.3.3; this file came with 0.3.4.
    if version == "0.3.3" and Path(spec.origin).parent.joinpath("sensors", "sensor_wrapper.py").is_file():
        version = "0.3.4"
    return HabitatInstallation(True, version)


def require_installed() -> HabitatInstallation:
    """The installation, when nothing speaks against loading it.

    Raises:
        SimulatorError: Habitat-Sim is not installed, or was made for another NumPy; the text says what to install.
    """
    found, numpy = inspect_installation(), version_of("numpy")
    if not found.installed:
        raise SimulatorError(HOW_TO_GET)
    if found.version and numpy and _numbers(found.version) < _FIRST_FOR_NUMPY_2 and _numbers(numpy) >= (2,):
        raise SimulatorError(
            f"habitat-sim {found.version} is installed but cannot run here: it was built for NumPy 1 and NumPy {numpy} "
            'is installed, with which it hands out wrong arrays; pip install "numpy<2", or install habitat-sim 0.3.4'
        )
    return found


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])
