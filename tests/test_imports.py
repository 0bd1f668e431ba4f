import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SUITE = ("avp_habitat", "avp_sb3", "avp_nerfstudio", "avp_experiment")
PROGRAMS = ("benchmarks", "scripts", "examples")
"""Beside the packages in a checkout, and not installed: they use the packages, never the other way round."""
MAY_IMPORT = {
    "avp_habitat": {"avp_habitat"},
    "avp_sb3": {"avp_sb3", "avp_habitat"},
    "avp_nerfstudio": {"avp_nerfstudio", "avp_habitat"},
    "avp_experiment": {"avp_experiment", "avp_nerfstudio", "avp_sb3", "avp_habitat"},
}
LIGHT = (
    "errors",
    "metrics",
    "plugins",
    "poses",
    "ranges",
    "task.rewards",
    "task.trajectory",
)
ENGINES = {
    "habitat_sim": {"simulators/habitat/engine.py"},
    "open3d": {"simulators/raycast.py", "geometry/shape.py", "geometry/fusion.py"},
}
NOT_AT_IMPORT = ("torch", "open3d", "habitat_sim", "mlflow", "rerun", "numba", "stable_baselines3", "trimesh", "scipy")


def imported(source, *, top_level_only=False):
    """Names of the modules that a source text imports."""
    tree = ast.parse(source)
    nodes = tree.body if top_level_only else ast.walk(tree)
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def wrong_directions(package, sources):
    """`(file, module)` of every import of what stands in a checkout and may not be imported from this package."""
    forbidden = {*SUITE, *PROGRAMS} - MAY_IMPORT[package]
    return [
        (name, module)
        for name, source in sources.items()
        for module in sorted(imported(source))
        if module.split(".")[0] in forbidden
    ]


def sources_of(package):
    folder = ROOT / package
    return {str(path.relative_to(folder)): path.read_text(encoding="utf-8") for path in folder.rglob("*.py")}


@pytest.mark.parametrize("package", SUITE)
def test_imports_between_the_packages_point_one_way(package):
    sources = sources_of(package)
    assert sources
    assert wrong_directions(package, sources) == []


@pytest.mark.parametrize(
    ("package", "line"),
    [
        ("avp_habitat", "import avp_sb3"),
        ("avp_habitat", "def late():\n    from avp_nerfstudio.data.dataparser import AVPDataParser"),
        ("avp_sb3", "from avp_nerfstudio import scores"),
        ("avp_nerfstudio", "import avp_sb3.vec_env.batched as vec"),
        *((package, f"from {program} import run") for package in SUITE for program in PROGRAMS),
    ],
)
def test_a_wrong_import_would_be_found(package, line):
    sources = {**sources_of(package), "new.py": line}
    assert [name for name, _ in wrong_directions(package, sources)] == ["new.py"]


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_import_numpy_and_the_standard_library_only(module):
    source = (ROOT / "avp_habitat" / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8")
    names = {name.split(".")[0] for name in imported(source, top_level_only=True)}
    assert names <= set(sys.stdlib_module_names) | {"numpy", "avp_habitat"}
    inner = {name.removeprefix("avp_habitat.") for name in imported(source) if name.startswith("avp_habitat.")}
    assert inner <= set(LIGHT)


@pytest.mark.parametrize("heavy", ENGINES)
def test_each_engine_is_imported_in_few_files(heavy):
    users = [
        name
        for name, source in sources_of("avp_habitat").items()
        if any(module.split(".")[0] == heavy for module in imported(source))
    ]
    assert set(users) <= ENGINES[heavy]


def test_nothing_that_reads_scenes_or_rollouts_can_load_a_pickle():
    # saved_model.py looks into the pickles that models of Stable-Baselines3 consist of before they are opened.
    readers = {name: text for name, text in sources_of("avp_habitat").items() if name != "policies/saved_model.py"}
    for name, source in readers.items():
        names = {module.split(".")[0] for module in imported(source)}
        assert not names & {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}, name
        assert "allow_pickle" not in source, name


def test_importing_avp_habitat_loads_nothing_heavy():
    code = "import sys, avp_habitat; print(' '.join(sorted(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "gymnasium" in loaded
    assert [name for name in NOT_AT_IMPORT if name in loaded] == []
