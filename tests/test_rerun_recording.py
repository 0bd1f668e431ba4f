import re
import shutil

import numpy as np
import pytest
from corridor import Corridor
from rrd import entities, rows, verify

from avp_habitat.env import AVPEnv
from avp_habitat.errors import RolloutError, UsageError
from avp_habitat.poses import Intrinsics
from avp_habitat.rollout_writer import RolloutWriter
from avp_habitat.settings import ACTION_NAMES
from avp_sb3.rerun_recording import write_rollout_recording

ACTIONS = (0, 1, 0, 4, 2)


@pytest.fixture(scope="module")
def rollout(tmp_path_factory):
    """A rollout of five steps, written by the suite's own writer."""
    camera = Intrinsics.from_hfov(24, 16, hfov_deg=90)
    env = AVPEnv(simulator=Corridor(), budget=len(ACTIONS), width=16, height=12)
    env.reset(seed=0)
    with RolloutWriter(tmp_path_factory.mktemp("rollouts") / "r (0)", camera) as writer:
        for action in ACTIONS:
            _, reward, _, _, info = env.step(action)
            frames = env.capture(env.camera_to_world[None], camera)
            writer.add_frame(frames.rgb[0], frames.depth[0], env.camera_to_world)
            place = dict(zip(("x_m", "y_m", "z_m"), env.agent_pose[0], strict=True))
            part = {f"reward_{name}": value for name, value in info["reward_parts"].items()}
            row = {"action": ACTION_NAMES[action], "reward": reward, "coverage": info["coverage"]}
            writer.add_step({**row, **part, **place})
        return writer.publish({})


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


def test_a_rollouts_steps_poses_and_pictures_are_recorded(rollout, tmp_path):
    root = shutil.copytree(rollout, tmp_path / "r0")
    target = write_rollout_recording([root], tmp_path / "r0.rrd")
    actions = [value[0] for _, value in rows(target, "/r0/plots/action", "Scalars:scalars")]
    assert actions == list(ACTIONS)
    assert len(rows(target, "/r0/world/camera/rgb", "EncodedImage:blob")) == len(ACTIONS)
    depth = rows(target, "/r0/world/camera/depth", "EncodedDepthImage:blob")
    stored = [value.astype(np.uint8).tobytes() for _, value in depth]
    assert stored == [path.read_bytes() for path in sorted((root / "depth").iterdir())]
    moved = rows(target, "/r0/world/agent", "Transform3D:translation")
    poses = [np.loadtxt(path) for path in sorted((root / "poses").iterdir())]
    np.testing.assert_allclose([value for _, value in moved], [pose[:3, 3] for pose in poses], atol=1e-6)
    assert {"/r0/plots/reward/sum", "/r0/plots/reward/spread", "/r0/plots/coverage"} <= entities(target)


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
        ("turn_left", "fly", r"expected actions out of move_forward, .*, found 'fly'"),
    ],
)
def test_a_wrong_table_of_steps_is_named(damaged, tmp_path, old, new, text):
    steps = damaged / "steps.csv"
    steps.write_text(re.sub(old, new, steps.read_text()))
    with pytest.raises(RolloutError, match=r"steps\.csv: " + text):
        write_rollout_recording([damaged], tmp_path / "a.rrd")


def test_a_missing_table_of_steps_is_named(damaged, tmp_path):
    (damaged / "steps.csv").unlink()
    with pytest.raises(RolloutError, match=r"steps\.csv: expected a table of steps"):
        write_rollout_recording([damaged], tmp_path / "a.rrd")


def test_an_unwritable_target_is_named(rollout, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RolloutError, match=r"a\.rrd: cannot write there: (Not a directory|File exists)"):
        write_rollout_recording([rollout], tmp_path / "file" / "a.rrd")
