"""Command line of the doctor: all checks side by side, one line each in a fixed order."""

import argparse
import contextlib
import dataclasses
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from avp_habitat import command
from avp_habitat.doctor import packages, simulators
from avp_habitat.doctor.asking import stop_all
from avp_habitat.doctor.finding import BROKEN, Finding
from avp_habitat.doctor.hosts import check_host
from avp_habitat.doctor.manifest import read_manifest
from avp_habitat.errors import AVPError


@dataclass(frozen=True)
class Check:
    """One check, which gives one or more lines."""

    name: str
    """For the progress line."""
    run: Callable[[], list[Finding]]
    """Does it."""
    seconds: float
    """About how long it takes; the long ones are started first."""


class Broken(AVPError):
    """Something of what the suite needs does not work; exit code 1."""


def all_checks() -> list[Check]:
    """The checks in the order of the report."""
    plugs = read_manifest()
    weights = {"nerfstudio": 8.0, "mlflow": 4.0, "rl_zoo3": 4.0, "stable-baselines3": 3.0}
    hosts = [
        Check(host, lambda host=host: check_host(host, [plug for plug in plugs if plug.host == host]), seconds)
        for host in dict.fromkeys(plug.host for plug in plugs)
        for seconds in [weights.get(host, 1.0)]
    ]
    return [
        Check("Python", packages.check_python, 0.0),
        Check("packages", packages.check_packages, 0.0),
        Check("numba", simulators.check_compiled, 2.0),
        Check("raycast", simulators.check_raycast, 5.0),
        Check("habitat", simulators.check_habitat, 7.0),
        Check("graphics", simulators.check_graphics, 0.3),
        Check("torch", simulators.check_cuda, 3.0),
        Check("LPIPS", simulators.check_lpips, 0.0),
        *hosts,
    ]


def findings_of(checks: Sequence[Check]) -> Iterator[Finding]:
    """The findings in the order of the checks, each as soon as it and those before it are known."""
    pool = ThreadPoolExecutor(max_workers=max(3, os.cpu_count() or 1))
    longest_first = sorted(checks, key=lambda check: -check.seconds)
    futures = {check.name: pool.submit(check.run) for check in longest_first}
    try:
        for check in checks:
            with _waiting_for(check.name, futures[check.name]):
                found = futures[check.name].result()
            yield from found
    finally:
        stop_all()
        pool.shutdown(wait=False, cancel_futures=True)


@contextlib.contextmanager
def _waiting_for(name: str, future: "Future[list[Finding]]") -> Iterator[None]:
    """Show on a terminal's last line what is being waited for."""
    text = f"looking at {name} ..." if sys.stderr.isatty() and not future.done() else ""
    print(text, end="\r" if text else "", file=sys.stderr, flush=True)
    try:
        yield
    finally:
        print(" " * len(text), end="\r" if text else "", file=sys.stderr, flush=True)


def main(argv: Sequence[str]) -> None:
    """Run every check and print what was found.

    Args:
        argv: command-line arguments.

    Raises:
        Broken: a check found something broken.
    """
    parser = argparse.ArgumentParser(
        prog="python -m avp_habitat.doctor",
        description="What is installed, what can run here and what the hosts see: ok, -- (not here, optional), !! "
        "(broken). Exit code 1 when anything is broken.",
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of lines")
    options = parser.parse_args(argv)
    found = []
    for finding in findings_of(all_checks()):
        found.append(finding)
        if not options.json:
            print(finding.line(colour=sys.stdout.isatty()), flush=True)
    broken = [finding.subject for finding in found if finding.mark == BROKEN]
    if options.json:
        print(json.dumps({"ok": not broken, "findings": [dataclasses.asdict(finding) for finding in found]}, indent=2))
    if broken:
        raise Broken(f"broken: {', '.join(broken)}; what to do stands in the lines marked {BROKEN}")


if __name__ == "__main__":
    sys.exit(command.run(main))
