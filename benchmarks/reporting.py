"""What every benchmark prints and keeps: an aligned table, and a JSON file that says what was measured and where."""

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from avp_habitat.errors import AVPError, UsageError
from avp_habitat.provenance import installed_versions

FORMAT_VERSION = 1
"""Of the JSON files; rises when a key changes its meaning."""
_PACKAGES = ("avp-suite", "open3d", "numba", "numpy", "stable-baselines3", "torch", "mlflow", "rerun-sdk")
_VARIABLES = ("AVP_CACHE", "AVP_MLFLOW_SPOOL")

Row = Mapping[str, Any]
Results = dict[str, list[dict[str, Any]]]
"""Rows by the name of their table."""


def parser(description: str | None, name: str) -> argparse.ArgumentParser:
    """A parser with the option that all benchmarks share.

    Args:
        description: the script's docstring.
        name: of the benchmark; its report is `runs/benchmark_NAME.json` unless `--out` says otherwise.
    """
    made = argparse.ArgumentParser(description=description, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    made.add_argument("--out", default=Path(f"runs/benchmark_{name}.json"), type=Path, help="the JSON report")
    return made


def check_least(options: argparse.Namespace, **least: float) -> None:
    """Refuse options below what makes sense.

    Args:
        options: parsed; an option may be a number or a list of numbers.
        least: the least value by the option's name.

    Raises:
        UsageError: an option is smaller.
    """
    for name, bound in least.items():
        value = getattr(options, name)
        values = value if isinstance(value, list) else [value]
        wrong = [entry for entry in values if not entry >= bound]
        if wrong or not values:
            found = wrong[0] if wrong else "none"
            raise UsageError(f"--{name.replace('_', '-')}: expected at least {bound}, got {found}")


def print_table(title: str, rows: Sequence[Row]) -> None:
    """Print rows under their keys, numbers to the right; what a row lacks is left empty."""
    if not rows:
        return
    keys = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[_text(row.get(key)) for key in keys] for row in rows]
    widths = [max(len(key), *(len(line[column]) for line in cells)) for column, key in enumerate(keys)]
    left = [all(isinstance(row.get(key), str | None) for row in rows) for key in keys]
    print(f"\n{title}")
    for line in (keys, ["-" * width for width in widths], *cells):
        aligned = (
            text.ljust(width) if first else text.rjust(width)
            for text, width, first in zip(line, widths, left, strict=True)
        )
        print("  ".join(aligned).rstrip())


@contextmanager
def reported(name: str, options: argparse.Namespace) -> Iterator[Results]:
    """Print and write what the block has measured when it is left, also by Ctrl-C or an error.

    Args:
        name: of the benchmark.
        options: parsed; `out` is the report's path.

    Yields:
        Where to put the rows of each table as they are measured.
    """
    results: Results = {}
    complete, commit = False, git_commit()
    try:
        yield results
        complete = True
    finally:
        if any(results.values()):
            for title, rows in results.items():
                print_table(title, rows)
            write_report(options.out, name, options, complete=complete, commit=commit, results=results)


@contextmanager
def own_folders(folder: Path) -> Iterator[None]:
    """Tables and MLflow's spool are kept in this folder, not among the user's, also by processes started meanwhile."""
    before = {name: os.environ.get(name) for name in _VARIABLES}
    os.environ.update({name: str(folder / name) for name in _VARIABLES})
    try:
        yield
    finally:
        for name, value in before.items():
            del os.environ[name]
            if value is not None:
                os.environ[name] = value


def write_report(
    path: Path, name: str, options: argparse.Namespace, *, complete: bool, commit: str | None, results: Results
) -> None:
    """Write the JSON report and say where it is.

    Args:
        path: where to; the file is whole or not there.
        name: of the benchmark.
        options: parsed.
        complete: False when Ctrl-C ended the measurements.
        commit: of the checkout when they began.
        results: rows by the name of their table.

    Raises:
        AVPError: the file cannot be written.
    """
    report = {
        "format_version": FORMAT_VERSION,
        "benchmark": name,
        "complete": complete,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": shlex.join(["python", f"benchmarks/{Path(sys.argv[0]).name}", *sys.argv[1:]]),
        "options": {key: _plain(value) for key, value in vars(options).items()},
        "git_commit": commit,
        "versions": installed_versions(_PACKAGES),
        "machine": machine(),
        "results": results,
    }
    temporary = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_text(json.dumps(report, indent=2) + "\n")
        os.replace(temporary, path)
    except OSError as error:
        raise AVPError(f"{path}: the report cannot be written: {error.strerror}") from error
    print(f"\n{path}: {'the whole report' if complete else 'what was measured before the interruption'}")


def write_page(report: Path, title: str, description: str | None, picture: str | None = None) -> None:
    """Write a JSON report as a Markdown page beside it.

    Args:
        report: as `write_report` left it.
        title: of the page.
        description: the script's docstring; all but its first paragraph stands above the tables.
        picture: what a picture beside the report (`.jpg`) shows, if there is one.
    """
    told = json.loads(report.read_text())
    here = told["machine"]
    facts = {
        "Command": f"`{told['command']}`",
        "Time": told["time"],
        "Seed": told["options"]["seed"],
        "Commit": told["git_commit"],
        "Machine": f"{here['cpus']} cores, {here['cpu_model']}, {here['system']}, load {here['load_average']:.1f}",
        "Versions": ", ".join(f"{name} {version}" for name, version in told["versions"].items()),
    }
    lines = [f"# {title}", "", *(description or "").partition("\n\n")[2].strip().splitlines(), ""]
    lines += [f"- {name}: {value}" for name, value in facts.items()]
    if picture is not None:
        lines += ["", f"![{picture}]({report.with_suffix('.jpg').name})"]
    for name, rows in told["results"].items():
        if rows:
            lines += ["", f"## {name.capitalize()}", "", *markdown(rows)]
    page = report.with_suffix(".md")
    temporary = page.with_name(page.name + ".part")
    temporary.write_text("\n".join(lines) + "\n")
    os.replace(temporary, page)
    print(f"{page}: the same as a page")


def markdown(rows: Sequence[Row]) -> list[str]:
    """Lines of a Markdown table of rows under their keys."""
    keys = list(dict.fromkeys(key for row in rows for key in row))
    lines = [keys, ["---"] * len(keys), *([_text(row.get(key)) for key in keys] for row in rows)]
    return [f"| {' | '.join(cells)} |" for cells in lines]


def machine() -> dict[str, Any]:
    """Processors that this process may use, their model, the memory in bytes and the load average of a minute."""
    return {
        "cpus": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "cpu_model": _cpu_model(),
        "memory_bytes": _memory(),
        "load_average": os.getloadavg()[0],
        "system": f"{platform.system()} {platform.release()}",
        "threads": {name: os.environ[name] for name in ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS") if name in os.environ},
    }


def git_commit() -> str | None:
    """The commit of this checkout, with `-dirty` when files differ from it; None without git or outside a checkout."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        answer = subprocess.run(
            command,
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _memory() -> int | None:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError):
        return None


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return value if isinstance(value, str | int | float | None) else str(value)


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, list):
        return " ".join(map(_text, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)
