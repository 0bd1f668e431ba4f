"""Rollouts as one Rerun recording: its bytes, or a file (`python -m avp_sb3.rerun.recording ROLLOUT … --out FILE`)."""

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import rerun as rr
from tqdm import tqdm

from avp_habitat.command import run
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.rollout.format import Rollout, read_rollout
from avp_sb3.rerun.destination import Destination, DestinationRecording, rollouts_at
from avp_sb3.rerun.episode import log_episode
from avp_sb3.rerun.layout import rollout_blueprint
from avp_sb3.rerun.rollout import PICTURES, Progress, RolloutContents, pictured, read_contents
from avp_sb3.rerun.room import log_room

_MOST_PICTURES = 400
_FLUSH_S = 60
# Of the rollouts' curves in one plot; they can be told apart by the colour-blind too.
_COLOURS = ((0, 114, 178), (230, 159, 0), (0, 158, 115), (213, 94, 0), (204, 121, 167), (86, 180, 233))


def log_rollout(recording: rr.RecordingStream, root: str, contents: RolloutContents) -> None:
    """Add a rollout as episode 0, with its pictures, room, map and figures.

    Args:
        recording: where to.
        root: entity path above `world`, `plots`, `metrics`, `map` and `about`.
        contents: of the rollout.
    """
    log_episode(recording, root, contents.episode, number=0)
    log_room(recording, f"{root}/world/room", *contents.room)
    if contents.map is not None:
        recording.log(f"{root}/map", rr.EncodedImage(contents=contents.map, media_type="image/png"), static=True)
    about = rr.TextDocument(contents.about, media_type=rr.MediaType.MARKDOWN)
    recording.log(f"{root}/about", about, static=True)
    last = max(len(contents.episode.camera_to_world) - 1, 0)
    for timeline, value in (("step", last), ("episode", 0), ("env_step", 0)):
        recording.set_time(timeline, sequence=value)
    for name, value in contents.metrics.items():
        recording.log(f"{root}/metrics/{_metric_path(name)}", rr.Scalars(value))
    recording.reset_time()


def recording_bytes(
    rollouts: Sequence[Rollout],
    destination: Destination,
    *,
    always_named: bool = False,
    progress: Progress = lambda: None,
) -> bytes:
    """A recording of rollouts in the format of `.rrd` files.

    All is read before anything is written, so that a damaged rollout leaves nothing that looks like a recording.

    Args:
        rollouts: as read by `avp_habitat.rollout.format.read_rollout`. Several lie under their folders' names, sharing
            at most 400 pictures; one has at most 100.
        destination: what they become part of.
        always_named: one rollout lies under its folder's name too.
        progress: called after each picture.

    Raises:
        RolloutError: a rollout is damaged.
    """
    names = _unique_names([rollout.folder.resolve().name for rollout in rollouts])
    above = f"/{destination.prefix.strip('/')}".rstrip("/")
    roots = [f"{above}/{rr.escape_entity_path_part(name)}" for name in names]
    if len(rollouts) == 1 and not always_named:
        roots = [above]
    pictures = _pictures_of_each(rollouts)
    contents = [read_contents(rollout, pictures=pictures, progress=progress) for rollout in rollouts]
    recording = DestinationRecording(destination)
    stream = recording.binary_stream()
    if destination.own:
        with_map = any(each.map is not None for each in contents)
        blueprint = rollout_blueprint(dict(zip(roots, names, strict=True)), with_map=with_map)
        # A default that arrives after the first data is too late: the viewer has made up a layout of its own by then.
        recording.send_blueprint(blueprint, make_active=True, make_default=True)
        recording.send_recording_name(", ".join(names))
    for index, (root, name, each) in enumerate(zip(roots, names, contents, strict=True)):
        log_rollout(recording, root, each)
        if len(roots) > 1:
            curve = rr.SeriesLines(names=[name], colors=[_COLOURS[index % len(_COLOURS)]])
            recording.log(f"{root}/plots/coverage", curve, static=True)
    written = stream.read(flush=True, flush_timeout_sec=_FLUSH_S)
    if not written:
        raise RolloutError("the recording could not be encoded: expected its bytes, got none")
    return written


def write_rollout_recording(folders: Sequence[str | Path], target: str | Path, *, progress: bool = False) -> Path:
    """Write one `.rrd` file with each rollout under its folder's name; the file appears when it is whole.

    Args:
        folders: rollout folders.
        target: the file to make.
        progress: show a progress bar.

    Raises:
        UsageError: the target exists, or no folder is given.
        RolloutError: a rollout is damaged, or the target cannot be written.
    """
    target = Path(target)
    if not folders:
        raise UsageError("expected at least one rollout folder, got none")
    _refuse_existing(target)
    rollouts = [read_rollout(folder) for folder in folders]
    total = sum(len(pictured(rollout, _pictures_of_each(rollouts))) for rollout in rollouts)
    with tqdm(total=total, unit="picture", desc=f"recording {target}", disable=None if progress else True) as bar:
        written = recording_bytes(rollouts, Destination(), always_named=True, progress=bar.update)
    temporary = target.parent / f".{target.name}.partial-{os.getpid()}"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(written)
        _refuse_existing(target)
        temporary.rename(target)
    except OSError as error:
        raise RolloutError(f"{target}: cannot write there: {error.strerror or error}") from None
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
    return target


def main(argv: Sequence[str]) -> None:
    """Write rollouts to one recording.

    Args:
        argv: the command line's arguments.

    Raises:
        AVPError: as `write_rollout_recording`.
    """
    parser = argparse.ArgumentParser(
        prog="python -m avp_sb3.rerun.recording",
        description="Write rollouts side by side to one recording; open it with `rerun FILE`.",
    )
    parser.add_argument("rollouts", nargs="+", help="rollout folders, or folders of rollouts")
    parser.add_argument("--out", required=True, type=Path, help="the .rrd file to make; must not exist")
    options = parser.parse_args(argv)
    _refuse_existing(options.out, option="--out ")
    folders = [folder for path in options.rollouts for folder in rollouts_at(path) or [path]]
    target = write_rollout_recording(folders, options.out, progress=True)
    print(f"{target}: {len(folders)} rollout{'s' * (len(folders) > 1)}, {target.stat().st_size / 1e6:.1f} MB")


def _metric_path(name: str) -> str:
    """As the callback's recordings name the figures of their episodes."""
    group = "return/" if name.startswith("return_") else ""
    return group + rr.escape_entity_path_part(name.removeprefix("return_"))


def _pictures_of_each(rollouts: Sequence[Rollout]) -> int:
    return max(1, min(PICTURES, _MOST_PICTURES // len(rollouts)))


def _refuse_existing(target: Path, option: str = "") -> None:
    if target.exists() or target.is_symlink():
        raise UsageError(f"{option}{target}: exists already; choose another name or remove it")


def _unique_names(names: Sequence[str]) -> list[str]:
    """Equal names numbered from the second one on."""
    unique: list[str] = []
    for name in names:
        candidate, count = name, 1
        while candidate in unique:
            count += 1
            candidate = f"{name}-{count}"
        unique.append(candidate)
    return unique


if __name__ == "__main__":
    sys.exit(run(main))
