"""Whether Habitat-Sim is installed and can be loaded by this Python, found out without importing it."""

import ctypes
import importlib.util
import mmap
import re
import sys
import sysconfig
from dataclasses import dataclass, field
from pathlib import Path

from avp_habitat.errors import SimulatorError
from avp_habitat.provenance import version_of

HOW_TO_GET = (
    "habitat-sim is not installed, and the package index has none; build version 0.3.4 from its sources "
    "(github.com/facebookresearch/habitat-sim, BUILD_FROM_SOURCE.md): conda's packages were reported to be for Python "
    "3.9 only (its issue 2625); or use --simulator raycast, which needs nothing"
)
LIBRARY_PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libOpenGL.so.0": "libopengl0",
    "libGL.so.1": "libgl1",
    "libGLX.so.0": "libglx0",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
}
_GRAPHICS = ("libEGL.so.1", "libOpenGL.so.0", "libGL.so.1")
# Modules that Habitat-Sim imports and whose package has another name.
_PACKAGE_OF = {"quaternion": "numpy-quaternion", "attr": "attrs", "git": "gitpython", "PIL": "pillow"}
# Versions up to 0.3.3 carry pybind11 2.10 and 2.11, which read NumPy 1's structures: with NumPy 2 such a module loads
# without a word and then hands out wrong arrays (tried with pybind11 2.11.1 and NumPy 2.3.5: element size 0).
_FIRST_FOR_NUMPY_2 = (0, 3, 4)
# Supported by the suite: 0.2.4 to 0.3.4. Conda's packages up to 0.3.3 were reported to be for Python 3.9 only.
_OLDEST = (0, 2, 4)


@dataclass(frozen=True)
class HabitatInstallation:
    """What is known of Habitat-Sim before it is imported."""

    folder: Path | None
    """Folder of the Python package; None where it is not installed."""
    version: str | None
    """Release number, for example `"0.3.4"`; None where nothing tells it."""
    built_for: str | None = None
    """Python that the extension module was built for (`"3.9"`); None where its name does not say."""
    problems: tuple[str, ...] = field(default=())
    """Why it cannot be loaded here, each with what to do; empty when nothing speaks against it."""

    @property
    def installed(self) -> bool:
        """Whether Python would find the package."""
        return self.folder is not None


def inspect_installation() -> HabitatInstallation:
    """Look for Habitat-Sim and for what would keep this Python from loading it; imports and opens nothing of it."""
    folder = _package_folder()
    if folder is None:
        return HabitatInstallation(None, None)
    version = _version(folder)
    extensions = sorted(folder.glob("_ext/habitat_sim_bindings*.so"))
    built_for = [_built_for(path.name) for path in extensions]
    fits = any(python is None or python == _this_python() for python in built_for)
    problems = [
        _wrong_python(built_for) if extensions and not fits else None,
        _too_old(version),
        _wrong_numpy(version),
        _missing_libraries(_needed_libraries(extensions)),
    ]
    return HabitatInstallation(
        folder,
        version,
        None if not extensions or None in built_for else ", ".join(sorted({str(python) for python in built_for})),
        tuple(problem for problem in problems if problem),
    )


def require_installed() -> HabitatInstallation:
    """The installation, when this Python can load it.

    Raises:
        SimulatorError: Habitat-Sim is not installed, or was built for another Python or NumPy, or a shared library
            that it needs is missing; the text says what to install.
    """
    found = inspect_installation()
    if not found.installed:
        raise SimulatorError(HOW_TO_GET)
    if found.problems:
        name = f"habitat-sim {found.version}" if found.version else "habitat-sim"
        raise SimulatorError(f"{name} is installed but cannot run here: {'; '.join(found.problems)}")
    return found


def cannot_load(error: ImportError) -> str:
    """One line for an error of `import habitat_sim`: what is wrong and what to install.

    Args:
        error: as Python raised it.
    """
    text = " ".join(str(error).split())
    library = re.search(r"(lib[\w+.-]+\.so[.\d]*): cannot open shared object file", text)
    if library:
        return f"habitat-sim is installed but cannot run here: {_missing_libraries([library[1]], present=False)}"
    if re.search(r"NumPy 1|numpy\.core\.multiarray|_ARRAY_API|numpy\.\w+ size changed", text):
        found = version_of("numpy") or "none"
        return f"habitat-sim or one of its packages was built for another NumPy than the {found} here: {text}"
    if re.search(r"(GLIBCXX|CXXABI|GLIBC)_[\d.]+' not found", text):
        return (
            f"habitat-sim was built with a newer compiler than this environment's libstdc++ ({text}); in a conda "
            "environment: conda install -c conda-forge libstdcxx-ng"
        )
    if isinstance(error, ModuleNotFoundError) and error.name:
        return _missing_module(error.name)
    return f"habitat-sim is installed but cannot be loaded: {text}; reinstall it in an environment of its own"


def _missing_module(name: str) -> str:
    top = name.split(".")[0]
    if top == "habitat_sim" and _package_folder() is None:
        return HOW_TO_GET
    if top in ("habitat_sim", "magnum", "corrade", "_magnum", "_corrade"):
        return f"habitat-sim's installation is incomplete: it has no module {name}; reinstall it"
    return f"habitat-sim needs the package {_PACKAGE_OF.get(top, top)}: pip install {_PACKAGE_OF.get(top, top)}"


def _package_folder() -> Path | None:
    try:
        spec = importlib.util.find_spec("habitat_sim")
    except (ImportError, ValueError):
        return None
    if spec is None or not spec.submodule_search_locations:
        return None
    folder = Path(next(iter(spec.submodule_search_locations)))
    # A folder of that name without code is a checkout's or a data folder on the path, not the package.
    return folder if (folder / "__init__.py").is_file() else None


def _version(folder: Path) -> str | None:
    found = _conda_version(folder) or version_of("habitat-sim")
    if found is None:
        written = re.search(r'__version__ = "([^"]+)"', (folder / "__init__.py").read_text(encoding="utf-8"))
        found = written[1] if written else None
    # The sources tagged v0.3.4 still call themselves 0.3.3; this file came with 0.3.4.
    if found == "0.3.3" and (folder / "sensors" / "sensor_wrapper.py").is_file():
        return "0.3.4"
    return found


def _conda_version(folder: Path) -> str | None:
    for prefix in (sys.prefix, sys.base_prefix):
        for record in Path(prefix, "conda-meta").glob("habitat-sim-[0-9]*.json"):
            if folder.is_relative_to(prefix):
                return record.name.split("-")[2]
    return None


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def _this_python() -> str:
    return f"{sys.version_info.major}.{sys.version_info.minor}"


def _built_for(file_name: str) -> str | None:
    if sysconfig.get_config_var("SOABI") in file_name.split("."):
        return _this_python()
    tag = re.search(r"\.cpython-(\d)(\d+)", file_name)
    return f"{tag[1]}.{tag[2]}" if tag else None


def _wrong_python(built_for: list[str | None]) -> str:
    here, theirs = _this_python(), ", ".join(sorted({str(python) for python in built_for}))
    where = f"{sys.platform}-{sysconfig.get_platform().split('-')[-1]}"
    return (
        f"it was built for Python {theirs} and this is Python {here} on {where}; build habitat-sim "
        "0.3.4 from its sources with this Python (BUILD_FROM_SOURCE.md in its repository)"
    )


def _too_old(version: str | None) -> str | None:
    if version is None or _numbers(version) >= _OLDEST:
        return None
    return f"the suite works with versions 0.2.4 to 0.3.4, not {version}; install 0.3.4"


def _wrong_numpy(version: str | None) -> str | None:
    numpy = version_of("numpy")
    if version is None or numpy is None or _numbers(version) >= _FIRST_FOR_NUMPY_2 or _numbers(numpy) < (2,):
        return None
    return (
        f"it was built for NumPy 1 and NumPy {numpy} is installed, with which it hands out wrong arrays; "
        'pip install "numpy<2", or install habitat-sim 0.3.4, which needs numpy>=2.0,<2.4'
    )


def _needed_libraries(extensions: list[Path]) -> list[str]:
    """Names of the graphics libraries that the extension module is linked to; all, where it cannot be read."""
    if not extensions:
        return list(_GRAPHICS)
    needed = []
    for name in _GRAPHICS:
        with extensions[0].open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            if content.find(f"\0{name}\0".encode()) >= 0:
                needed.append(name)
    return needed


def _missing_libraries(names: list[str], *, present: bool = True) -> str | None:
    """What to install for the libraries of a list that cannot be loaded (`present=False`: for all of them)."""
    missing = [name for name in names if not (present and _can_load(name))]
    if not missing:
        return None
    packages = [LIBRARY_PACKAGES.get(name, f"the package that holds {name}") for name in missing]
    if set(missing) & set(_GRAPHICS):
        packages += ["libegl-mesa0", "libgl1-mesa-dri"]
    return f"{', '.join(missing)} cannot be loaded; Debian, Ubuntu: apt-get install {' '.join(packages)}"


def _can_load(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True
