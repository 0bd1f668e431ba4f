"""Versions of Python, the suite and the packages against the ranges that the suite asks for."""

import platform
import sys
from importlib import metadata

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from avp_habitat.doctor.finding import ABSENT, BROKEN, OK, Finding
from avp_habitat.doctor.manifest import DISTRIBUTION, requirements
from avp_habitat.provenance import version_of

_INSTALL = "pip install -e . in the checkout"


def check_python() -> list[Finding]:
    """Python and the suite themselves."""
    here = platform.python_version()
    version = version_of(DISTRIBUTION)
    if version is None:
        return [
            Finding(OK, "Python", f"{here} ({sys.executable})"),
            Finding(BROKEN, DISTRIBUTION, f"not installed, so that no host can see its plugs; {_INSTALL}"),
        ]
    asked = SpecifierSet(metadata.metadata(DISTRIBUTION)["Requires-Python"])
    fits = asked.contains(here, prereleases=True)
    wanted = "" if fits else f", but the suite needs {asked}: make an environment with such a Python"
    return [
        Finding(OK if fits else BROKEN, "Python", f"{here} ({sys.executable}){wanted}"),
        Finding(OK, DISTRIBUTION, version),
    ]


def check_packages() -> list[Finding]:
    """One line per required package; one line for what is not installed of an extra."""
    asked = requirements() or {}
    findings = [_required(requirement) for requirement in asked.get(None, [])]
    seen = {finding.subject for finding in findings}
    for extra, wanted in asked.items():
        if extra is None:
            continue
        present = [requirement for requirement in wanted if version_of(requirement.name) is not None]
        findings += [_required(requirement) for requirement in present if requirement.name not in seen]
        seen |= {requirement.name for requirement in present}
        missing = [requirement.name for requirement in wanted if version_of(requirement.name) is None]
        if missing:
            text = f"not installed: {', '.join(missing)}; pip install '{DISTRIBUTION}[{extra}]'"
            findings.append(Finding(ABSENT, f"extra {extra}", text))
    return findings


def _required(requirement: Requirement) -> Finding:
    found, asked = version_of(requirement.name), str(requirement.specifier)
    fix = f'pip install "{requirement.name}{asked}"'
    if found is None:
        return Finding(BROKEN, requirement.name, f"not installed, and the suite needs it; {fix}")
    if not requirement.specifier.contains(found, prereleases=True):
        return Finding(BROKEN, requirement.name, f"{found}, but the suite needs {asked}; {fix}")
    return Finding(OK, requirement.name, f"{found} (needs {asked})")
