"""`python -m avp_habitat.doctor`: what is installed, what can run here, what its hosts see, and the fix where not."""

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
import tomllib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from avp_habitat.errors import AVPError
from avp_habitat.provenance import version_of

DISTRIBUTION, MANIFEST = "avp-suite", "plugins.toml"
OK, ABSENT, BROKEN = "ok", "--", "!!"
_COLOURS = {OK: "\033[32m", ABSENT: "\033[2m", BROKEN: "\033[1;31m"}
_SILENT = {"PYTHONWARNINGS": "ignore", "MAGNUM_LOG": "quiet", "HABITAT_SIM_LOG": "quiet", "TF_CPP_MIN_LOG_LEVEL": "3"}
_AGAIN = "pip install -e . in the checkout, or reinstall the wheel"
_NOT_MINE = 66  # Rerun's contract for the programs that it offers every opened path to


# Some hosts leave threads behind that would keep the process, and drivers may crash while Python is taken down.
_PROBE = "import json, os, sys; from {} import {} as f; print(json.dumps(f(*sys.argv[1:])), flush=True); os._exit(0)"


class Finding(NamedTuple):
    """One line of the report: how it is, what was looked at, what was found and what to do."""

    mark: str
    subject: str
    text: str

    def line(self, *, colour: bool) -> str:
        """The finding as a line of text, with terminal colours or without."""
        mark = f"{_COLOURS[self.mark]}{self.mark}\033[0m" if colour else self.mark
        return f"{mark}  {self.subject:<26} {' '.join(self.text.split())}"


class Plug(NamedTuple):
    """One entry of `plugins.toml`: who loads it, where the host looks for it, its name, `module:name`, an example."""

    host: str
    group: str
    name: str
    object: str
    shows: str


def manifest_path() -> Path:
    """Path of `plugins.toml`: beside the packages in a checkout, else where the wheel put it."""
    folders = Path(__file__).resolve().parents
    for path in (folders[2] / MANIFEST, *(folder / "share" / DISTRIBUTION / MANIFEST for folder in folders)):
        if path.is_file():
            return path
    raise AVPError(f"{folders[2] / MANIFEST}: the manifest of plugs is missing; reinstall the suite")


def read_manifest() -> list[Plug]:
    """Every plug of the manifest, in its order."""
    return [Plug(**entry) for entry in tomllib.loads(manifest_path().read_text(encoding="utf-8"))["plugin"]]


def requirements() -> dict[str, list[Requirement]]:
    """What the installed suite asks for, by extra (empty: always); nothing when the suite is not installed."""
    lines = (metadata.requires(DISTRIBUTION) or []) if version_of(DISTRIBUTION) else []
    asked: dict[str, list[Requirement]] = {"": [], "sb3": [], "nerfstudio": []}
    for requirement in map(Requirement, lines):
        extras = [extra for extra in asked if not requirement.marker or requirement.marker.evaluate({"extra": extra})]
        for extra in [""] if "" in extras else extras:
            asked[extra].append(requirement)
    return asked


def check_python() -> list[Finding]:
    """Python and the suite themselves."""
    here, version = f"{platform.python_version()} ({sys.executable})", version_of(DISTRIBUTION)
    if version is None:
        text = "not installed, so that no host can see its plugs; pip install -e . in the checkout"
        return [Finding(OK, "Python", here), Finding(BROKEN, DISTRIBUTION, text)]
    asked = SpecifierSet(metadata.metadata(DISTRIBUTION)["Requires-Python"])
    fits = asked.contains(platform.python_version(), prereleases=True)
    wanted = "" if fits else f", but the suite needs {asked}: make an environment with such a Python"
    return [Finding(OK if fits else BROKEN, "Python", here + wanted), Finding(OK, DISTRIBUTION, version)]


def check_packages() -> list[Finding]:
    """One line per required package; one line for what is not installed of an extra."""
    findings: dict[str, Finding] = {}
    for extra, wanted in requirements().items():
        missing = [requirement.name for requirement in wanted if version_of(requirement.name) is None]
        for requirement in wanted:
            if not extra or requirement.name not in missing:
                findings.setdefault(requirement.name, _required(requirement))
        if extra and missing:
            text = f"not installed: {', '.join(missing)}; pip install '{DISTRIBUTION}[{extra}]'"
            findings[f"extra {extra}"] = Finding(ABSENT, f"extra {extra}", text)
    return list(findings.values())


def _required(requirement: Requirement) -> Finding:
    found, asked = version_of(requirement.name), str(requirement.specifier)
    fix = f'pip install "{requirement.name}{asked}"'
    if found is None:
        return Finding(BROKEN, requirement.name, f"not installed, and the suite needs it; {fix}")
    if not requirement.specifier.contains(found, prereleases=True):
        return Finding(BROKEN, requirement.name, f"{found}, but the suite needs {asked}; {fix}")
    return Finding(OK, requirement.name, f"{found} (needs {asked})")


def probe(look: Callable[..., Any], *arguments: str) -> list[str]:
    """Words for Python to call a function in a process of its own, because it may crash, hang or print."""
    return ["-c", _PROBE.format(look.__module__, look.__name__), *arguments]


def ask(words: list[str], *, time_limit_s: float) -> tuple[Any, str | None]:
    """The JSON value that Python with these words prints as its last line, or None and why it did not."""
    how: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace", "env": {**os.environ, **_SILENT}}
    try:
        done = subprocess.run([sys.executable, *words], timeout=time_limit_s, check=False, **how)
    except subprocess.TimeoutExpired:
        return None, f"gave no answer within {time_limit_s:.0f} s"
    said, told = (["", *filter(None, map(str.strip, text.splitlines()))][-1] for text in (done.stdout, done.stderr))
    if done.returncode < 0:
        return None, f"crashed with {signal.Signals(-done.returncode).name}{f' ({told})' if told else ''}"
    if done.returncode > 0:
        return None, told or f"ended with exit code {done.returncode}"
    try:
        return json.loads(said), None
    except ValueError:
        return None, f"said {said!r} instead of JSON"


def check_host(host: str, plugs: list[Plug]) -> list[Finding]:
    """One finding for each of the plugs of a host, which the manifest calls so."""
    package = "rerun-sdk" if host == "rerun" else host
    version = version_of(package)
    extras = [extra for extra, wanted in requirements().items() if extra and package in {one.name for one in wanted}]
    get = f"pip install '{DISTRIBUTION}[{extras[0]}]'" if extras else f"pip install {package}"
    if version is None:
        return [Finding(ABSENT, f"plug {plug.name}", f"{host} is not installed; {get}") for plug in plugs]
    if host == "rerun":
        return [_program(plug, version) for plug in plugs]
    # Importing nerfstudio took more than 90 s on a cold or busy disk and two cores.
    reasons, failure = ask(probe(reasons_of, json.dumps(plugs)), time_limit_s=240.0)
    if failure is not None:
        text = f"{host} {version} cannot be asked: {failure}; {get} in a new environment"
        return [Finding(BROKEN, f"plug {plug.name}", text) for plug in plugs]
    return [_seen(plug, version, reason) for plug, reason in zip(plugs, reasons, strict=True)]


def _seen(plug: Plug, version: str, reason: str | None) -> Finding:
    subject = f"plug {plug.name}"
    points = metadata.entry_points(group=plug.group, name=plug.name)
    if plug.group.startswith(("nerfstudio.", "mlflow.")) and not any(point.value == plug.object for point in points):
        return Finding(BROKEN, subject, f"the installed suite has no such entry point ({plug.group}); {_AGAIN}")
    if reason is not None:
        return Finding(BROKEN, subject, f"{plug.host} {version} does not see it ({reason}); {_AGAIN}")
    return Finding(OK, subject, f"seen by {plug.host} {version} ({plug.group})")


def _program(plug: Plug, version: str) -> Finding:
    subject, found, scripts = f"plug {plug.name}", shutil.which(plug.name), sysconfig.get_path("scripts")
    if found is None and not (Path(scripts) / plug.name).is_file():
        return Finding(BROKEN, subject, f"the program is not installed; {_AGAIN}")
    if found is None:
        text = f'{plug.host} looks for it on the PATH, where {scripts} is not; export PATH="{scripts}{os.pathsep}$PATH"'
        return Finding(ABSENT, subject, text)
    # It has to leave paths that are not its own to other importers.
    try:
        code = subprocess.run([found, os.devnull], capture_output=True, timeout=30.0, check=False).returncode
    except (OSError, subprocess.TimeoutExpired) as error:
        return Finding(BROKEN, subject, f"{found} cannot be run ({error}); {_AGAIN}")
    if code != _NOT_MINE:
        text = f"{found} ended with exit code {code} on a path that is not its own, not {_NOT_MINE}; {_AGAIN}"
        return Finding(BROKEN, subject, text)
    return Finding(OK, subject, f"{found}, for {plug.host} {version}")


_SEES: dict[str, Callable[[Plug], Any]] = {
    "registration on import": lambda plug: resolve_name("gymnasium:spec")(plug.name),
    "wrapper": lambda plug: _is_a(plug, "gymnasium:Wrapper"),
    "callback": lambda plug: _is_a(plug, "stable_baselines3.common.callbacks:BaseCallback"),
    "VecEnv": lambda plug: _is_a(plug, "stable_baselines3.common.vec_env:VecEnv"),
    "--conf-file": lambda plug: resolve_name(plug.object),
    "vec_env_wrapper": lambda plug: resolve_name("rl_zoo3.utils:get_wrapper_class")({"": plug.name}, ""),
    "nerfstudio.method_configs": lambda plug: plug.name in _discovered("registry:discover_methods"),
    "nerfstudio.dataparser_configs": lambda plug: plug.name in _discovered("registry_dataparser:discover_dataparsers"),
    "mlflow.run_context_provider": lambda plug: any(type(one) is resolve_name(plug.object) for one in _providers()),
}
"""Whether the host of a plug sees it, by the plug's group."""


def _is_a(plug: Plug, kind: str) -> bool:
    return issubclass(resolve_name(plug.object), resolve_name(kind))


def _discovered(function: str) -> Any:
    return resolve_name(f"nerfstudio.plugins.{function}")()[0]


def _providers() -> Any:
    return resolve_name("mlflow.tracking.context.registry:_run_context_provider_registry")


def reasons_of(plugs: str) -> list[str | None]:
    """Why the hosts do not see plugs, which are given as JSON; None for each that is seen."""
    return [_reason(Plug(*fields)) for fields in json.loads(plugs)]


def _reason(plug: Plug) -> str | None:
    try:
        if _SEES[plug.group](plug):
            return None
        # The suite's entry points for nerfstudio give a stand-in with the reason for a plug that could not be made.
        return str(getattr(resolve_name(plug.object), "reason", f"{plug.object} is no {plug.group}"))
    except Exception as error:  # whatever a host or a plug raises is the answer
        return " ".join(f"{type(error).__name__}: {error}".split())


def open_room(simulator: str) -> dict[str, str]:
    """How a simulator opens the built-in room and renders one small frame: `mark` and `text` of a finding."""
    import numpy as np

    from avp_habitat.poses import Intrinsics
    from avp_habitat.simulators.registry import make_simulator

    start = time.monotonic()
    try:
        opened = make_simulator(simulator, "builtin:0")
        pose = np.eye(4)
        pose[:3, 3] = opened.area.random_points(np.random.default_rng(0), 1)[0] + [0.0, 1.5, 0.0]
        frames = opened.render(pose[None], Intrinsics.from_hfov(32, 24, hfov_deg=90.0), rgb=True)
    except AVPError as error:
        return {"mark": BROKEN, "text": str(error)}
    if frames.rgb is None or not frames.depth.any():
        return {"mark": BROKEN, "text": "it rendered an empty picture of the built-in room"}
    text = f"{opened.version}: opened builtin:0 and rendered in {time.monotonic() - start:.1f} s"
    return {"mark": OK, "text": text}
