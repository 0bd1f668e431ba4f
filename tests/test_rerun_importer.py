import csv
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest
from rerun.chunk import RrdReader
from rrd import chunks, entities, rows, verify
from small_rollout import ACTIONS, write_small_rollout

from avp_sb3.rerun import importer

SCRIPTS = Path(sysconfig.get_path("scripts"))
NAMES = ("rerun-importer-avp", "rerun-loader-avp")
HEAVY = {"numpy", "rerun", "PIL", "gymnasium", "avp_habitat", "tqdm", "pyarrow", "csv", "json"}
BARE_PATH = "/usr/bin:/bin"
ADDED = "Scalars:scalars"
SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def rollout(tmp_path_factory):
    return write_small_rollout(tmp_path_factory.mktemp("rollouts") / "r0")


@pytest.fixture
def damaged(rollout, tmp_path):
    return shutil.copytree(rollout, tmp_path / "damaged")


@pytest.fixture
def call(monkeypatch, capfdbinary, tmp_path):
    """Calls the importer's entry point in this process; exit code, recording (if any) and stderr."""

    def called(path, *flags, name=NAMES[0]):
        monkeypatch.setattr(sys, "argv", [str(SCRIPTS / name), str(path), *flags])
        code = importer.main()
        out, err = capfdbinary.readouterr()
        target = tmp_path / "answer.rrd"
        target.write_bytes(out)
        return code, target if out else None, err.decode()

    return called


def script(name, *arguments, path=BARE_PATH, python=(), **options):
    environment = {**os.environ, "PATH": path}
    command = [sys.executable, *python, SCRIPTS / name, *map(str, arguments)]
    return subprocess.run(command, env=environment, stdin=subprocess.DEVNULL, timeout=120, **options)


def rerun(*arguments, folder, target):
    """What the real program saved of the paths, and what it printed."""
    environment = {**os.environ, "PATH": f"{SCRIPTS}{os.pathsep}{BARE_PATH}"}
    flags = ["--save", target, "--port", "auto", "--bind", "127.0.0.1"]
    command = [SCRIPTS / "rerun", *map(str, arguments), *flags]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    return target, done.stdout + done.stderr


def actions(path, root=""):
    return [value[0] for _, value in rows(path, f"{root}/plots/action", ADDED)]


def stores(path):
    return [(store.application_id, store.recording_id) for store in RrdReader(path).recordings()]


def blueprints(path):
    return RrdReader(path).blueprints()


def written(path, content):
    path.write_bytes(content)
    return path


def pipe(path):
    os.mkfifo(path)
    return path


def huge(path):
    with path.open("wb") as file:
        file.truncate(1 << 36)
    return path


def half_written(folder):
    (folder / ".r0.partial-1").mkdir()
    written(folder / ".r0.partial-1" / "rollout.json", b'{"format": "avp-rollout"}')
    return folder


FOREIGN = {
    "empty folder": lambda folder: folder,
    "folder of files": lambda folder: written(folder / "notes.txt", b"avp-rollout").parent,
    "folder of a rollout being written": half_written,
    "foreign rollout.json": lambda folder: written(folder / "rollout.json", b'{"format": "other-rollout"}'),
    "other json": lambda folder: written(folder / "other.json", b'{"format": "avp-rollout"}'),
    "huge rollout.json": lambda folder: huge(folder / "rollout.json"),
    "pipe": lambda folder: pipe(folder / "rollout.json"),
    "binary": lambda folder: written(folder / "a.bin", bytes(range(256)) * 64),
    "missing": lambda folder: folder / "none" / "rollout.json",
}
"""What is no rollout: given an empty folder, makes it there."""


@pytest.mark.parametrize("kind", FOREIGN)
def test_what_is_no_rollout_is_declined_in_silence(call, tmp_path, kind):
    (tmp_path / "given").mkdir()
    path = FOREIGN[kind](tmp_path / "given")
    assert call(path, "--application-id", "given", "--recording-id", "x") == (66, None, "")


@pytest.mark.parametrize("part", ["steps.csv", "transforms.json", "images", "images/frame_00000.png", "trajectory.png"])
def test_parts_of_a_rollout_are_declined(call, rollout, part):
    assert call(rollout / part) == (66, None, "")


def imported(*arguments, name=NAMES[0]):
    """The exit code of the real script, and the packages that it imported."""
    done = script(name, *arguments, python=("-X", "importtime"), capture_output=True)
    lines = [line for line in done.stderr.decode(errors="replace").splitlines() if line.startswith("import time:")]
    return done.returncode, {line.split("|")[-1].strip().split(".")[0] for line in lines}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", ["folder of files", "foreign rollout.json", "huge rollout.json"])
def test_declining_imports_nothing_heavy(tmp_path, kind, name):
    code, packages = imported(FOREIGN[kind](tmp_path), name=name)
    assert code == 66
    assert "avp_sb3" in packages
    assert not packages & HEAVY


def test_what_answering_imports_would_be_noticed(rollout):
    code, packages = imported(rollout)
    assert code == 0
    assert packages >= HEAVY


def test_help_is_free_of_heavy_imports(tmp_path):
    assert imported("--help")[0] == 0
    assert not imported("--help")[1] & HEAVY


def test_the_folder_and_its_description_give_the_same_recording(call, rollout, tmp_path):
    _, by_folder, _ = call(rollout)
    kept = shutil.copy(by_folder, tmp_path / "by_folder.rrd")
    code, by_file, err = call(rollout / "rollout.json")
    assert (code, err) == (0, "")
    verify(by_file)
    assert entities(by_file) == entities(kept)
    assert actions(by_file) == actions(kept) == list(ACTIONS)
    assert {"/world/room", "/world/camera/rgb", "/map", "/about", "/metrics/coverage"} <= entities(by_file)
    assert len(blueprints(by_file)) == 1


def test_the_layout_is_used_at_once(call, rollout):
    """A default that follows the first data is not: the viewer keeps the layout that it has made up by then."""
    _, recording, _ = call(rollout)
    printed = subprocess.run([SCRIPTS / "rerun", "rrd", "print", "-v", recording], capture_output=True, text=True)
    assert re.search(r"BlueprintActivationCommand\(.*make_active: true, make_default: true\)", printed.stdout)


def test_counts_equal_the_rows_of_the_table(call, rollout):
    with (rollout / "steps.csv").open() as file:
        table = list(csv.DictReader(file))
    _, recording, _ = call(rollout)
    for entity, component in (
        ("/plots/coverage", ADDED),
        ("/plots/reward/sum", ADDED),
        ("/world/agent", "Transform3D:translation"),
        ("/world/camera/rgb", "EncodedImage:blob"),
        ("/world/camera/depth", "EncodedDepthImage:blob"),
    ):
        assert [step for step, _ in rows(recording, entity, component)] == [*range(len(table))]
    coverage = [value[0] for _, value in rows(recording, "/plots/coverage", ADDED, "episode")]
    np.testing.assert_allclose(coverage, [float(row["coverage"]) for row in table])


def test_the_recording_is_the_one_that_was_asked_for(call, rollout):
    _, recording, _ = call(rollout, "--application-id", "shown", "--recording-id", "rec_1")
    assert stores(recording) == [("shown", "rec_1")]


def test_unknown_flags_are_tolerated(call, rollout, tmp_path):
    times = ("--time_sequence", "frame=7", "--time_duration_nanos", "wall=-17", "--sequence", "wall=-17")
    flags = ("--recording-id", "rec_1", *times, "--timeline-type", "duration", "--new-flag", "--static", "--timeless")
    code, recording, err = call(rollout, *flags)
    assert (code, err) == (0, "")
    assert actions(recording) == list(ACTIONS)
    assert call(tmp_path, *flags)[0] == 66


def test_beneath_a_prefix_name_and_layout_are_the_applications(call, rollout):
    _, recording, _ = call(rollout, "--entity-path-prefix", "/robot/one")
    assert actions(recording, "/robot/one") == list(ACTIONS)
    assert {entity.split("/")[1] for entity in entities(recording)} == {"robot"}
    assert not blueprints(recording)


def test_a_recording_that_is_joined_keeps_its_name(call, rollout):
    flags = ("--application-id", "mine", "--recording-id", "x", "--opened-application-id", "mine")
    _, recording, _ = call(rollout, *flags, "--opened-recording-id", "x")
    assert stores(recording) == [("mine", "x")]
    assert not blueprints(recording)
    assert not any(chunk.entity_path.startswith("/__properties") for chunk in chunks(recording))


def break_json(folder):
    (folder / "rollout.json").write_text('{"format": "avp-rollout", ')


def wrong_version(folder):
    path = folder / "rollout.json"
    path.write_text(path.read_text().replace('"format_version": 1', '"format_version": 99'))


def missing_image(folder):
    (folder / "images" / "frame_00003.png").unlink()


def unreadable_image(folder):
    path = folder / "images" / "frame_00003.png"
    data = path.read_bytes()
    # Between the head (33 bytes, 8 of the first chunk, 2 of its stream) and the end (a checksum and the last chunk).
    path.write_bytes(data[:43] + bytes(len(data) - 59) + data[-16:])


def wrong_size(folder):
    shutil.copy(folder / "trajectory.png", folder / "images" / "frame_00003.png")


def broken_map(folder):
    path = folder / "trajectory.png"
    path.write_bytes(path.read_bytes()[:200])


def nan_pose(folder):
    path = folder / "poses" / "frame_00003.txt"
    path.write_text("nan " + path.read_text().split(" ", 1)[1])


def stretched_pose(folder):
    path = folder / "poses" / "frame_00003.txt"
    np.savetxt(path, np.loadtxt(path) * np.array([2, 1, 1, 1]))


def table_not_fetched(folder):
    (folder / "steps.csv").unlink()
    (folder / "steps.csv").symlink_to(folder.parent / "store")


def folder_for_table(folder):
    (folder / "steps.csv").unlink()
    (folder / "steps.csv").mkdir()


def no_column(folder):
    path = folder / "steps.csv"
    path.write_text(path.read_text().replace("coverage,", "covered,", 2))


def no_last_row(folder):
    path = folder / "steps.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (break_json, r"rollout\.json: expected JSON, could not read it"),
        (wrong_version, r"rollout\.json: expected format version 1, found 99"),
        (missing_image, r"images/frame_00003\.png: expected this file"),
        (unreadable_image, r"images/frame_00003\.png: expected a readable PNG, could not decode it"),
        (wrong_size, r"images/frame_00003\.png: expected .*24x16"),
        (broken_map, r"trajectory\.png: expected a readable PNG, could not decode it"),
        (nan_pose, r"poses/frame_00003\.txt: not a rigid camera_to_world: .*"),
        (stretched_pose, r"poses/frame_00003\.txt: not a rigid camera_to_world: .*"),
        (table_not_fetched, r"steps\.csv: expected a table of steps, could not read it: .*No such file"),
        (folder_for_table, r"steps\.csv: expected a table of steps, could not read it"),
        (no_column, r"steps\.csv: expected a column 'coverage', found action, "),
        (no_last_row, r"steps\.csv: expected one row per frame \(5\), found 4"),
    ],
)
def test_damage_is_named_in_one_line_and_nothing_is_written(call, damaged, damage, text):
    damage(damaged)
    code, recording, err = call(damaged, "--recording-id", "x", "--application-id", "damaged")
    assert (code, recording) == (1, None)
    assert re.fullmatch(rf"error: [^\n]*{text}[^\n]*\n", err), err


def test_a_damaged_rollout_among_others_leaves_nothing(call, rollout, damaged):
    shutil.copytree(rollout, damaged.parent / "whole")
    missing_image(damaged)
    code, recording, err = call(damaged.parent)
    assert (code, recording) == (1, None)
    assert "damaged/images/frame_00003.png" in err


def test_the_rollouts_of_a_folder_lie_side_by_side(call, rollout, tmp_path):
    folder = tmp_path / "all"
    shutil.copytree(rollout, folder / "a")
    shutil.copytree(rollout, folder / "b")
    (folder / "other").mkdir()
    _, recording, _ = call(folder)
    verify(recording)
    assert actions(recording, "/a") == actions(recording, "/b") == list(ACTIONS)
    assert {entity.split("/")[1] for entity in entities(recording)} == {"a", "b"}


@pytest.mark.parametrize(("path", "code"), [("", 0), (str(SCRIPTS), 66)])
def test_the_deprecated_name_leaves_the_answer_to_the_new_one(call, rollout, monkeypatch, path, code):
    monkeypatch.setenv("PATH", path)
    assert call(rollout, "--recording-id", "x", name=NAMES[1])[0] == code
    assert call(rollout, name=NAMES[1])[0] == 0


@pytest.mark.parametrize("application", ["r0", "all"])
def test_a_file_is_left_to_the_folder_that_is_being_opened(call, rollout, tmp_path, application):
    folder = shutil.copytree(rollout, tmp_path / "all" / "r0")
    for name in ("rollout.json", "steps.csv"):
        flags = ("--application-id", application, "--recording-id", "x")
        assert call(folder / name, *flags) == (0, None, "")
    assert call(folder / "rollout.json", "--application-id", "rollout", "--recording-id", "x")[1]
    assert call(folder / "steps.csv", "--application-id", "steps", "--recording-id", "x")[0] == 66


@SLOW
def test_a_viewer_that_leaves_is_no_crash(rollout):
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = script(NAMES[0], rollout, stdout=writing, stderr=subprocess.PIPE)
    finally:
        os.close(writing)
    assert done.returncode == 1
    assert done.stderr == b""


@pytest.mark.parametrize(
    ("current", "opened"),
    [
        ("", "rollout/rollout.json"),
        pytest.param("", "r0", marks=SLOW),
        pytest.param("r0", ".", marks=SLOW),
    ],
)
def test_rerun_opens_a_rollout_once(rollout, tmp_path, current, opened):
    shutil.copytree(rollout, tmp_path / "rollout")
    shutil.copytree(rollout, tmp_path / "r0")
    recording, printed = rerun(opened, folder=tmp_path / current, target=tmp_path / "saved.rrd")
    verify(recording)
    assert "ERROR" not in printed
    assert actions(recording) == list(ACTIONS)
    assert len(rows(recording, "/world/camera/rgb", "EncodedImage:blob")) == len(ACTIONS)
    assert len(blueprints(recording)) == 1


@SLOW
def test_rerun_opens_a_folder_of_rollouts(rollout, tmp_path):
    for name in ("a", "b"):
        shutil.copytree(rollout, tmp_path / "all" / name)
    recording, printed = rerun("all", folder=tmp_path, target=tmp_path / "saved.rrd")
    assert "ERROR" not in printed
    assert actions(recording, "/a") == actions(recording, "/b") == list(ACTIONS)
    assert not actions(recording)
    assert len(stores(recording)) == 1


@SLOW
def test_rerun_prints_what_is_wrong_with_a_damaged_rollout(damaged, tmp_path):
    missing_image(damaged)
    recording, printed = rerun("damaged", folder=tmp_path, target=tmp_path / "saved.rrd")
    assert "images/frame_00003.png: expected this file" in printed
    assert not actions(recording)


SDK = """
import sys, rerun as rr
rr.init("host", recording_id="session")
rr.save(sys.argv[2])
rr.set_time("frame", sequence=7)
rr.set_time("clock", timestamp=1.7e9)
rr.log_file_from_path(sys.argv[1], entity_path_prefix="/shown")
rr.log("end", rr.TextLog("end"))
"""


@SLOW
def test_an_application_logs_a_rollout_into_its_own_recording(rollout, tmp_path):
    target = tmp_path / "host.rrd"
    environment = {**os.environ, "PATH": f"{SCRIPTS}{os.pathsep}{BARE_PATH}"}
    command = [sys.executable, "-c", SDK, rollout / "rollout.json", target]
    subprocess.run(command, env=environment, check=True, timeout=120, capture_output=True)
    assert stores(target) == [("host", "session")]
    assert actions(target, "/shown") == list(ACTIONS)
