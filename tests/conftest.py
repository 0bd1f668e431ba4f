import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared() -> Path:
    """Real scenes and weights that lie beside some checkouts, never inside the project."""
    folder = ROOT.parent / "shared"
    if not (folder / "scenes").is_dir():
        pytest.skip(f"{folder.name}/scenes does not lie beside this checkout: real rooms are not part of the project")
    return folder


@pytest.fixture(scope="session", autouse=True)
def quiet_threads() -> None:
    """Subprocesses of tests share two cores with the tests."""
    os.environ.setdefault("OMP_NUM_THREADS", "2")


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Tables of scenes that tests make do not fill the user's cache."""
    os.environ["AVP_CACHE"] = str(tmp_path_factory.mktemp("cache"))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of Habitat-Sim are skipped where it cannot be loaded, for the reason that its users would read."""
    from avp_habitat.errors import SimulatorError
    from avp_habitat.simulators.habitat.installed import require_installed

    try:
        require_installed()
    except SimulatorError as error:
        for item in items:
            if item.get_closest_marker("habitat"):
                item.add_marker(pytest.mark.skip(reason=str(error).split(";")[0]))
