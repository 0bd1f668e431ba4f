"""Which plugs of the manifest their hosts see."""

import dataclasses
import os
import shutil
import subprocess
import sysconfig
from importlib import metadata
from pathlib import Path

from avp_habitat.doctor.ask_host import HOSTS
from avp_habitat.doctor.asking import ask
from avp_habitat.doctor.finding import ABSENT, BROKEN, OK, Finding
from avp_habitat.doctor.manifest import DISTRIBUTION, Plug, requirements
from avp_habitat.provenance import version_of

_HOST_LIMIT_S = 90.0
_PROGRAM_LIMIT_S = 30.0
_NOT_MINE = 66
# Rerun's contract for the programs that it offers every opened path to.
_PACKAGE_OF = {"rerun": "rerun-sdk"}
_AGAIN = "pip install -e . in the checkout, or reinstall the wheel"


def check_host(host: str, plugs: list[Plug]) -> list[Finding]:
    """One finding for each plug of one host.

    Args:
        host: as the manifest calls it.
        plugs: the manifest's entries of that host.
    """
    package = _PACKAGE_OF.get(host, host)
    version = version_of(package)
    if version is None:
        text = f"{host} is not installed; {_how_to_get(package)}"
        return [Finding(ABSENT, f"plug {plug.name}", text) for plug in plugs]
    programs = [_program(plug, version) for plug in plugs if plug.group == "program on the path"]
    others = [plug for plug in plugs if plug.group != "program on the path"]
    return programs + (_asked(host, version, others) if others else [])


def _how_to_get(package: str) -> str:
    for extra, wanted in (requirements() or {}).items():
        if extra is not None and any(requirement.name == package for requirement in wanted):
            return f"pip install '{DISTRIBUTION}[{extra}]'"
    return f"pip install {package}"


def _asked(host: str, version: str, plugs: list[Plug]) -> list[Finding]:
    if host not in HOSTS:
        return [Finding(OK, f"plug {plug.name}", f"{host} {version} is installed; try: {plug.shows}") for plug in plugs]
    entries = [dataclasses.asdict(plug) for plug in plugs]
    answer = ask(["-m", "avp_habitat.doctor.ask_host", host], time_limit_s=_HOST_LIMIT_S, question=entries)
    if answer.failure is not None:
        text = f"{host} {version} cannot be asked: {answer.failure}; {_how_to_get(host)} in a new environment"
        return [Finding(BROKEN, f"plug {plug.name}", text) for plug in plugs]
    return [_seen(plug, version, answer.value[f"{plug.name}\n{plug.group}"]) for plug in plugs]


def _seen(plug: Plug, version: str, reason: str | None) -> Finding:
    subject = f"plug {plug.name}"
    if _entry_point_missing(plug):
        return Finding(BROKEN, subject, f"the installed suite has no such entry point ({plug.group}); {_AGAIN}")
    if reason is not None:
        return Finding(BROKEN, subject, f"{plug.host} {version} does not see it ({reason}); {_AGAIN}")
    return Finding(OK, subject, f"seen by {plug.host} {version} ({plug.group})")


def _entry_point_missing(plug: Plug) -> bool:
    if not plug.group.startswith(("nerfstudio.", "mlflow.")):
        return False
    found = metadata.entry_points(group=plug.group, name=plug.name)
    return not any(point.value == plug.object for point in found)


def _program(plug: Plug, version: str) -> Finding:
    subject = f"plug {plug.name}"
    found = shutil.which(plug.name)
    if found is None:
        scripts = sysconfig.get_path("scripts")
        if not (Path(scripts) / plug.name).is_file():
            return Finding(BROKEN, subject, f"the program is not installed; {_AGAIN}")
        text = f'{plug.host} looks for it on the PATH, where {scripts} is not; export PATH="{scripts}{os.pathsep}$PATH"'
        return Finding(ABSENT, subject, text)
    # It has to leave paths that are not its own to other importers.
    try:
        done = subprocess.run([found, os.devnull], capture_output=True, timeout=_PROGRAM_LIMIT_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return Finding(BROKEN, subject, f"{found} cannot be run ({error}); {_AGAIN}")
    if done.returncode != _NOT_MINE:
        text = (
            f"{found} ended with exit code {done.returncode} on a path that is not its own, not {_NOT_MINE}; {_AGAIN}"
        )
        return Finding(BROKEN, subject, text)
    return Finding(OK, subject, f"{found}, for {plug.host} {version}")
