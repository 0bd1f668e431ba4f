import pytest

from avp_habitat import command
from avp_habitat.collect import main as collect
from avp_habitat.errors import UsageError
from avp_habitat.scenes.builtin.room import generate_room
from avp_habitat.scenes.export import export_glb
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.env import AVPEnv
from avp_sb3 import AVPVecEnv, EvaluationCallback
from avp_sb3.evaluate import main as evaluate

WRONG = [
    (["--gpu", "0"], "--gpu: is of the simulator 'habitat', but 'raycast' was chosen; leave it out, or choose"),
    (["--simulator", "habitat", "--gpu", "-2"], "--gpu: expected a CUDA device from 0, or -1 for none, got -2"),
    (["--simulator", "habitatt"], "unknown simulator 'habitatt': expected one of habitat, raycast; did you mean"),
]


@pytest.mark.parametrize("main", [collect, evaluate])
@pytest.mark.parametrize(("words", "error"), WRONG)
def test_commands_refuse_options_that_cannot_be_right(tmp_path, monkeypatch, capsys, main, words, error):
    monkeypatch.chdir(tmp_path)
    line = ["--scene", "builtin:0", "--policy", "random", "--out", "r", *words]
    assert command.run(main, line) == 2
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 1
    assert told[0].startswith(f"error: {error}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "make",
    [
        lambda **options: make_simulator("raycast", "builtin:0", **options),
        lambda **options: AVPEnv("builtin:0", **options),
        lambda **options: AVPVecEnv("builtin:0", **options),
        lambda **options: EvaluationCallback("builtin:0", **options),
    ],
)
def test_options_of_another_simulator_are_refused_everywhere(make):
    with pytest.raises(UsageError, match=r"^gpu: is of the simulator 'habitat', but 'raycast' was chosen"):
        make(gpu=-1)


def test_a_missing_navmesh_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "room.navmesh").touch()
    line = ["--scene", "builtin:0", "--policy", "random", "--out", "r", "--navmesh", "rom.navmesh"]
    assert command.run(collect, line) == 1
    told = capsys.readouterr().err
    assert told == "error: rom.navmesh: no such NavMesh file (.navmesh); did you mean 'room.navmesh'?\n"
    assert [path.name for path in tmp_path.iterdir()] == ["room.navmesh"]


@pytest.mark.parametrize("gpu", [-2, True, "0", 1.0])
def test_what_is_no_device_is_refused(gpu):
    with pytest.raises(UsageError, match=f"gpu: expected a CUDA device from 0, or -1 for none, got {gpu!r}"):
        AVPEnv("builtin:0", simulator="habitat", gpu=gpu)


def test_an_open_simulator_takes_no_options():
    simulator = make_simulator("raycast", "builtin:0")
    for cls in (AVPEnv, AVPVecEnv):
        with pytest.raises(UsageError, match="gpu: expected none beside a simulator that is open already, got 0"):
            cls(simulator=simulator, gpu=0)


def test_one_scene_of_several_spellings_is_one_simulator(tmp_path, monkeypatch):
    export_glb(generate_room(0), tmp_path / "room.glb")
    monkeypatch.chdir(tmp_path)
    assert make_simulator("raycast", "room.glb") is make_simulator("raycast", str(tmp_path / "room.glb"))


def test_several_scenes_in_a_simulator_for_one_are_refused_before_any_is_opened():
    with pytest.raises(UsageError, match=r"AVPVecEnv: .* one 'habitat' simulator.*AVPSubprocVecEnv"):
        AVPVecEnv(["builtin:0", "builtin:1"], simulator="habitat")


def test_an_environment_changes_its_scene():
    env = AVPEnv("builtin:0", width=16, height=12)
    other = AVPEnv("builtin:1", width=16, height=12)
    env.change_scene("builtin:1")
    assert (env.scene, env.scene_name, env.simulator) == ("builtin:1", "builtin:1", other.simulator)
    assert (env.reset(seed=4)[0] == other.reset(seed=4)[0]).all()
    with pytest.raises(UsageError, match="change_scene: expected a simulator chosen by name"):
        AVPEnv(simulator=env.simulator).change_scene("builtin:2")
