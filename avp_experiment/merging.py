"""Results of several experiments of the same settings, merged into those of one."""

import glob
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from avp_experiment.configuration import known_methods, scene_slug
from avp_experiment.folder import write_json
from avp_experiment.results import (
    FILE,
    FORMAT,
    PARTS,
    PICTURES,
    Results,
    as_results,
    commits_of,
    entries_of,
    load_results,
)
from avp_habitat.errors import AVPError, UsageError
from avp_habitat.files import atomic_folder

_MAY_DIFFER = ("starts", "scenes", "rooms", "metrics")
"""Parts of the configuration that say what was measured, not how."""


@dataclass(frozen=True)
class Merged:
    """Merged results, checked and not yet written."""

    out: Path
    content: dict[str, Any]
    """Of `results.json`."""
    pictures: Mapping[str, Path]
    """Of figure 6: the files to copy, by their new names."""

    def write(self) -> None:
        """Write pictures and `results.json`; those of an earlier merge are replaced."""
        try:
            if (self.out / PICTURES).exists():
                shutil.rmtree(self.out / PICTURES)
            with atomic_folder(self.out / PICTURES) as partial:
                for name, path in self.pictures.items():
                    shutil.copyfile(path, partial / name)
            write_json(self.out / FILE, self.content, separators=(",", ":"))
        except OSError as error:
            raise AVPError(f"--out {self.out}: cannot write there: {error.strerror or error}") from None


@dataclass
class _Row:
    """A method as one experiment measured it, or as several did whose parts belong together."""

    method: str
    """Its name where it was measured."""
    labels: list[str]
    entries: dict[str, list[Any]]
    """By part."""
    pictures: dict[tuple[str, str], Path]
    """Renders by scene, as files call it, and number of the view."""

    @property
    def episodes(self) -> set[tuple[str, int, int]]:
        measured = (*self.entries["rollouts"], *self.entries["reconstructions"])
        return {(one["scene"], one["seed"], one["start"]) for one in measured}

    def holds(self, other: "_Row") -> bool:
        """Whether all that the other one found is here."""
        return all(one in self.entries[part] for part in PARTS for one in other.entries[part])

    def continues(self, other: "_Row") -> bool:
        """Whether these are other episodes of the same policies by the same commits.

        Of weights and classes of users the name says nothing.
        """
        if self.method not in known_methods():
            return False
        trained = {one["seed"]: one for one in other.entries["training"]}
        same_policies = all(trained.get(one["seed"], one) == one for one in self.entries["training"])
        commits = commits_of(self.entries)
        same_commits = bool(commits) and commits == commits_of(other.entries)
        return same_policies and same_commits and not self.episodes & other.episodes

    def add(self, other: "_Row") -> None:
        self.labels += [label for label in other.labels if label not in self.labels]
        for part, entries in self.entries.items():
            entries += [one for one in other.entries[part] if one not in entries]
        self.pictures |= other.pictures


def merge(folders: Sequence[Path], out: Path) -> Merged:
    """Merge the results of some folders (docs/experiment.md says how); nothing is written yet.

    Raises:
        UsageError: the results do not belong together, or `out` holds something else.
        AVPError: results are damaged.
    """
    _check_out(folders, out)
    values = [load_results(folder) for folder in folders]
    several = [as_results(folder, value) for folder, value in zip(folders, values, strict=True)]
    configuration, figures = _configuration(several), _figures(several)
    origins, failed, rows = _measured(several, values)
    named: dict[str, _Row] = {}
    for row in _joined(rows):
        named[f"{row.method} ({row.labels[0]})" if row.method in named else row.method] = row
    content = {
        "format": FORMAT,
        "configuration": configuration,
        "methods": list(named),
        "figures": figures,
        "origins": origins,
        "sources": {name: row.labels for name, row in named.items()},
        **{
            part: [one | {"method": name} for name, row in named.items() for one in row.entries[part]] for part in PARTS
        },
        "failed": failed,
    }
    shown = [("truth", _pictures(results, "truth")) for results in several]
    shown += [(name, row.pictures) for name, row in named.items()]
    pictures = {f"{slug}-{name}-{number}.png": path for name, of in shown for (slug, number), path in of.items()}
    return Merged(out, content, pictures)


def _measured(
    several: Sequence[Results], values: Sequence[Mapping[str, Any]]
) -> tuple[dict[str, Any], list[Any], list[_Row]]:
    """Origins by labels that are distinct, cells that failed, and rows."""
    origins: dict[str, Any] = {}
    failed: list[Any] = []
    rows: list[_Row] = []
    for results, value in zip(several, values, strict=True):
        labels: dict[str, str] = {}
        for label, origin in results.origins.items():
            labels[label] = _distinct(label, origins)
            origins[labels[label]] = origin
        failed += [{**one, "label": labels[one.get("label", next(iter(labels)))]} for one in results.failed]
        for method in results.methods:
            rows.append(_row(results, value, method, labels))
    return origins, failed, rows


def _check_out(folders: Sequence[Path], out: Path) -> None:
    expected = "expected a new or empty folder, or one of an earlier merge"
    if out.resolve() in [folder.resolve() for folder in folders]:
        raise UsageError(f"--out {out}: is one of the folders to merge; {expected}")
    if (out / FILE).is_file():
        if "origins" not in load_results(out):
            raise UsageError(f"--out {out}: holds the results of an experiment; {expected}")
    elif out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"--out {out}: holds something else; {expected}")


def _configuration(several: Sequence[Results]) -> dict[str, Any]:
    """Of the first one, with the scenes, rooms and users' metrics of all and the most starts."""
    first, found = several[0], dict(several[0].configuration)
    for results in several[1:]:
        told = _differences(first, first.configuration, results, results.configuration, skipped=_MAY_DIFFER)
        if told:
            other = first.configuration.get("preset") != results.configuration.get("preset")
            what = "presets or versions of a benchmark" if other else "settings"
            # Two presets differ in much: their names say it.
            said = told.partition("; ")[0] if other else told
            raise UsageError(f"{said}: results of different {what} cannot be merged")
    for name in ("rooms", "metrics"):
        if union := dict.fromkeys(one for results in several for one in results.configuration.get(name, ())):
            found[name] = list(union)
    if starts := [results.configuration["starts"] for results in several if "starts" in results.configuration]:
        found["starts"] = max(starts)
    return found | {"scenes": _scenes(several)}


def _differences(
    one: Results, values: Mapping[str, Any], other: Results, others: Mapping[str, Any], *, skipped: Sequence[str] = ()
) -> str:
    """What two results give different values for, the preset first; empty if nothing."""
    names = sorted({*values, *others} - set(skipped), key=lambda name: (name != "preset", name))
    return "; ".join(
        f"{name} {values.get(name)} in {one.folder}, {others.get(name)} in {other.folder}".removeprefix("preset ")
        for name in names
        if values.get(name) != others.get(name)
    )


def _scenes(several: Sequence[Results]) -> list[dict[str, Any]]:
    found: list[tuple[Results, dict[str, Any]]] = []
    for results in several:
        for scene in results.configuration["scenes"]:
            for other, known in found:
                # Pictures are called by the name without its suffix.
                same_name = scene_slug(scene["name"]) == scene_slug(known["name"])
                if not same_name and scene["sha256"] != known["sha256"]:
                    continue
                if told := _differences(other, known, results, scene):
                    raise UsageError(f"scene {scene['name']}: {told}: expected one name, sha256 and role for a scene")
                break
            else:
                found.append((results, scene))
    return [scene for _, scene in found]


def _figures(several: Sequence[Results]) -> dict[str, Any]:
    found: dict[str, tuple[Results, dict[str, Any]]] = {}
    for results in several:
        for name, figure in results.figures.items():
            other, known = found.setdefault(name, (results, asdict(figure)))
            if told := _differences(other, known, results, asdict(figure)):
                raise UsageError(f"figure {name}: {told}: expected one definition of a figure")
    return {name: figure for name, (_, figure) in found.items()}


def _distinct(label: str, taken: Mapping[str, Any]) -> str:
    count, found = 1, label
    while found in taken:
        count += 1
        found = f"{label} {count}"
    return found


def _row(results: Results, value: Mapping[str, Any], method: str, labels: Mapping[str, str]) -> _Row:
    """A method of a folder, under the name it had before any merge."""
    own = results.sources[method]
    name = method.removesuffix(f" ({own[0]})")
    entries = {part: [one | {"method": name} for one in found] for part, found in entries_of(value, method).items()}
    return _Row(name, [labels[label] for label in own], entries, _pictures(results, method))


def _pictures(results: Results, shown: str) -> dict[tuple[str, str], Path]:
    """Files of held-out views, by scene, as files call it, and number of the view: of the truth or a method."""
    found = {}
    for slug in (scene_slug(scene["name"]) for scene in results.configuration["scenes"]):
        for path in sorted((results.folder / PICTURES).glob(f"{glob.escape(f'{slug}-{shown}-')}*.png")):
            if (number := path.stem.rpartition("-")[2]) == path.stem.removeprefix(f"{slug}-{shown}-"):
                found[slug, number] = path
    return found


def _joined(rows: Sequence[_Row]) -> list[_Row]:
    """Rows of which others hold all, or that are empty beside others, are dropped; parts of one become one."""
    kept = [row for number, row in enumerate(rows) if not _needless(row, rows[:number], rows[number + 1 :])]
    found: list[_Row] = []
    for row in kept:
        whole = next((one for one in found if one.method == row.method and row.continues(one)), None)
        if whole is None:
            found.append(row)
        else:
            whole.add(row)
    return found


def _needless(row: _Row, before: Sequence[_Row], after: Sequence[_Row]) -> bool:
    same, later = ([one for one in rows if one.method == row.method] for rows in (before, after))
    # Of equal ones the first is kept.
    return any(one.holds(row) for one in same) or any(one.holds(row) and not row.holds(one) for one in later)
