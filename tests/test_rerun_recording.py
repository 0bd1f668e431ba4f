import csv
import io
import json
import re
import resource
import shutil

import numpy as np
import pytest
from PIL import Image
from rrd import chunks, entities, rows, verify
from small_rollout import ACTIONS, write_small_rollout

from avp_habitat.command import run
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout.format import read_rollout
from avp_habitat.rollout.writing import RolloutWriter
from avp_sb3.rerun.__main__ import main
from avp_sb3.rerun.rollout import read_contents, write_rollout_recording


@pytest.fixture(scope="module")
def rollout(tmp_path_factory):
    return write_small_rollout(tmp_path_factory.mktemp("rollouts") / "r (0)")


@pytest.fixture(scope="module")
def recorded(rollout, tmp_path_factory):
    """A rollout of a simpler name, and its recording."""
    folder = tmp_path_factory.mktemp("recorded")
    root = shutil.copytree(rollout, folder / "r0")
    return root, write_rollout_recording([root], folder / "r0.rrd")


@pytest.fixture
def damaged(rollout, tmp_path):
    return shutil.copytree(rollout, tmp_path / "damaged")


def test_rollouts_lie_side_by_side_under_their_names(rollout, tmp_path):
    other = shutil.copytree(rollout, tmp_path / "other")
    twin = shutil.copytree(rollout, tmp_path / "deep" / "other")
    target = write_rollout_recording([rollout, other, twin], tmp_path / "new" / "all.rrd")
    verify(target)
    tops = {entity.split("/")[1] for entity in entities(target)}
    assert tops == {"r\\ \\(0\\)", "other", "other-2"}
    assert [path.name for path in target.parent.iterdir()] == ["all.rrd"]


@pytest.mark.parametrize("timeline", ["step", "episode"])
def test_every_row_of_the_table_is_plotted_on_both_time_lines(recorded, timeline):
    root, target = recorded
    with (root / "steps.csv").open() as file:
        table = list(csv.DictReader(file))
    names = {"reward": "reward/sum", "coverage": "coverage"}
    names |= {name: "reward/" + name.removeprefix("reward_") for name in table[0] if name.startswith("reward_")}
    assert len(names) > 5
    for column, plot in names.items():
        found = rows(target, f"/r0/plots/{plot}", "Scalars:scalars", timeline)
        assert [time for time, _ in found] == ([*range(len(table))] if timeline == "step" else [0] * len(table))
        np.testing.assert_allclose([value[0] for _, value in found], [float(row[column]) for row in table])
    assert [value[0] for _, value in rows(target, "/r0/plots/action", "Scalars:scalars")] == list(ACTIONS)


@pytest.mark.parametrize("entity", ["agent", "camera"])
def test_poses_are_those_of_the_files(recorded, entity):
    root, target = recorded
    poses = np.array([np.loadtxt(path) for path in sorted((root / "poses").iterdir())])
    path = f"/r0/world/{entity}"
    places = [value for _, value in rows(target, path, "Transform3D:translation")]
    turns = [value.reshape(3, 3).T for _, value in rows(target, path, "Transform3D:mat3x3")]
    np.testing.assert_allclose(places, poses[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose(turns, poses[:, :3, :3], atol=1e-6)


def test_pictures_are_those_of_the_files(recorded):
    root, target = recorded
    pictures = rows(target, "/r0/world/camera/rgb", "EncodedImage:blob")
    files = sorted((root / "images").iterdir())
    assert [step for step, _ in pictures] == [*range(len(files))]
    for (_, blob), path in zip(pictures, files, strict=True):
        shown = np.asarray(Image.open(io.BytesIO(blob.astype(np.uint8).tobytes())), dtype=int)
        np.testing.assert_allclose(shown, np.asarray(Image.open(path), dtype=int), atol=40)
        assert np.abs(shown - np.asarray(Image.open(path), dtype=int)).mean() < 4
    depths = [value.astype(np.uint8).tobytes() for _, value in rows(target, "/r0/world/camera/depth", DEPTH)]
    assert depths == [path.read_bytes() for path in sorted((root / "depth").iterdir())]


DEPTH = "EncodedDepthImage:blob"


def test_metrics_stand_at_the_last_step(recorded):
    root, target = recorded
    metrics = json.loads((root / "rollout.json").read_text())["metrics"]
    for name, path in (("coverage", "coverage"), ("annd_m", "annd_m"), ("return_spread", "return/spread")):
        (found,) = rows(target, f"/r0/metrics/{path}", "Scalars:scalars")
        assert found[0] == len(ACTIONS) - 1
        assert found[1][0] == pytest.approx(metrics[name])
    wanted = {f"/r0/metrics/{name.replace('return_', 'return/')}" for name in metrics}
    assert wanted <= entities(target)
    assert {"/r0/map", "/r0/about", "/r0/world/room", "/r0/world/path"} <= entities(target)


def test_the_room_lies_on_the_surfaces_that_the_depth_files_show(recorded):
    root, _ = recorded
    points, colours = read_contents(read_rollout(root)).room
    surfaces = []
    camera = json.loads((root / "rollout.json").read_text())["camera"]
    for pose, depth in zip(sorted((root / "poses").iterdir()), sorted((root / "depth").iterdir()), strict=True):
        z = np.asarray(Image.open(depth)) / 1000
        v, u = np.nonzero((z > 0) & (z <= 10))
        z = z[v, u]
        x, y = (u + 0.5 - camera["cx"]) / camera["fx"] * z, (v + 0.5 - camera["cy"]) / camera["fy"] * z
        local = np.stack([x, -y, -z, np.ones_like(z)])
        surfaces.append((np.loadtxt(pose) @ local)[:3].T)
    pixels = np.concatenate(surfaces)
    nearest = [np.abs(pixels - point).max(axis=1).min() for point in points]
    assert len(points) == len(colours) > 50
    assert max(nearest) < 0.05


def test_large_pictures_are_subsampled_with_their_camera(tmp_path):
    big = write_small_rollout(tmp_path / "big", ACTIONS[:2], width=1282, height=26)
    stored = (np.arange(26 * 1282, dtype=np.uint16) + 500).reshape(26, 1282)
    Image.fromarray(stored).save(big / "depth" / "frame_00000.png")
    episode = read_contents(read_rollout(big)).episode
    camera, view = episode.intrinsics, episode.views[0]
    assert (camera.width, camera.height, camera.cx) == (427, 8, pytest.approx(1282 / 2 / 3))
    rgb, depth = Image.open(io.BytesIO(view.rgb)), np.asarray(Image.open(io.BytesIO(view.depth)))
    assert rgb.size == depth.shape[::-1] == (427, 8)
    np.testing.assert_array_equal(depth, stored[1:24:3, 1:1281:3])


def test_pictures_are_spread_over_a_long_rollout(rollout):
    views = read_contents(read_rollout(rollout), pictures=3).episode.views
    assert sorted(views) == [0, 2, 4]


def test_an_existing_target_is_refused_and_kept(rollout, tmp_path):
    target = tmp_path / "a.rrd"
    target.write_text("mine")
    with pytest.raises(UsageError, match=r"a\.rrd: exists already; choose another name or remove it"):
        write_rollout_recording([rollout], target)
    assert target.read_text() == "mine"


def test_no_rollout_is_refused(tmp_path):
    with pytest.raises(UsageError, match="at least one rollout folder"):
        write_rollout_recording([], tmp_path / "a.rrd")


def test_a_damaged_rollout_leaves_no_file(damaged, tmp_path):
    steps = damaged / "steps.csv"
    steps.write_text("\n".join(steps.read_text().splitlines()[:-1]))
    with pytest.raises(RolloutError, match=r"steps\.csv: expected one row per frame \(5\), found 4"):
        write_rollout_recording([damaged], tmp_path / "a.rrd")
    assert [path.name for path in tmp_path.iterdir()] == ["damaged"]


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("x_m", "x_feet", r"expected a column 'x_m', found action, reward, "),
        ("turn_left", "fly", r"expected actions out of move_forward, .* in column 'action', found 'fly' in row 2"),
        (r"turn_left,[^,]*,", "turn_left,nan,", r"expected finite numbers in column 'reward', found 'nan' in row 2"),
        (r"turn_left,[^,]*,", "turn_left,much,", r"expected finite numbers in column 'reward', found 'much' in row 2"),
        (r"turn_left,[^,]*,", "turn_left,", r"expected \d+ columns, found \d+ in row 2"),
        (r"turn_left,", "turn_left,1,", r"expected \d+ columns, found \d+ in row 2"),
        (r"(?s).*", "", r"expected one row per frame \(5\), found 0"),
    ],
)
def test_a_wrong_table_of_steps_is_named(damaged, tmp_path, old, new, text):
    steps = damaged / "steps.csv"
    steps.write_text(re.sub(old, new, steps.read_text()))
    with pytest.raises(RolloutError, match=r"steps\.csv: " + text):
        write_rollout_recording([damaged], tmp_path / "a.rrd")


def test_a_missing_table_of_steps_is_named(damaged, tmp_path):
    (damaged / "steps.csv").unlink()
    with pytest.raises(RolloutError, match=r"steps\.csv: expected a table of steps, could not read it: .*No such file"):
        write_rollout_recording([damaged], tmp_path / "a.rrd")


def test_metrics_that_are_no_numbers_are_named(damaged, tmp_path):
    meta = damaged / "rollout.json"
    meta.write_text(re.sub(r'"annd_m": [^,]*', '"annd_m": NaN', meta.read_text()))
    with pytest.raises(RolloutError, match=r"rollout\.json: expected JSON, could not read it: Out of range float"):
        write_rollout_recording([damaged], tmp_path / "a.rrd")


def test_an_unwritable_target_is_named(rollout, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RolloutError, match=r"a\.rrd: cannot write there: (Not a directory|File exists)"):
        write_rollout_recording([rollout], tmp_path / "file" / "a.rrd")


def test_a_disk_that_takes_no_more_leaves_nothing(rollout, tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(RolloutError, match=r"a\.rrd: cannot write there: File too large"):
            write_rollout_recording([rollout], tmp_path / "a.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_a_rollout_without_frames_is_recorded(tmp_path):
    with RolloutWriter(tmp_path / "empty", Intrinsics.from_hfov(24, 16, hfov_deg=90)) as writer:
        writer.add_step(dict.fromkeys(["action", "reward", "coverage", "x_m", "y_m", "z_m"], 0))
        folder = writer.publish({})
    (folder / "steps.csv").write_text("action,reward,coverage,x_m,y_m,z_m\n")
    verify(write_rollout_recording([folder], tmp_path / "empty.rrd"))


def newest(path, entity, component):
    """The static value that a viewer shows: of several, that of the greatest row id, which holds the time."""
    found = []
    for chunk in chunks(path):
        batch = chunk.to_record_batch()
        if chunk.entity_path == entity and chunk.is_static and component in batch.schema.names:
            found += zip(batch.column(0).to_pylist(), batch.column(component).to_pylist(), strict=True)
    return max(found)[1]


def test_the_command_records_the_rollouts_of_a_folder(rollout, tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(rollout, tmp_path / "all" / name)
    target = tmp_path / "both.rrd"
    assert run(main, [str(tmp_path / "all"), "--out", str(target)]) == 0
    assert re.search(r"both\.rrd: 2 rollouts, \d+\.\d MB", capsys.readouterr().out)
    assert {entity.split("/")[1] for entity in entities(target)} == {"a", "b"}
    colours = [newest(target, f"/{name}/plots/coverage", "SeriesLines:colors") for name in ("a", "b")]
    assert colours[0] != colours[1]
    assert run(main, [str(rollout), "--out", str(target)]) == 2
    assert "--out " in capsys.readouterr().err


def test_the_command_names_what_is_no_rollout(tmp_path, capsys):
    assert run(main, [str(tmp_path / "none"), "--out", str(tmp_path / "a.rrd")]) == 1
    assert re.search(r"error: .*none: expected a rollout folder", capsys.readouterr().err)
    assert not list(tmp_path.iterdir())
