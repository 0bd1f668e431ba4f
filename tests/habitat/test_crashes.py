"""What ends a process inside Habitat-Sim is an error of ours, and does end a process that has not our guards."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from shapes import furnished, write_room

from avp_habitat.simulators.habitat.graphics import inspect_graphics

pytestmark = pytest.mark.habitat

ROOT = Path(__file__).resolve().parents[2]
GUARDED = """
import gc, os, signal, sys, threading, time
import numpy as np
from avp_habitat import command
from avp_habitat.errors import AVPError
from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.simulators.habitat import HabitatSimulator

room = sys.argv[1]
camera = Intrinsics.from_hfov(16, 12, hfov_deg=90.0)
pose = camera_to_world(np.array([[1.0, 1.5, 1.0]]), yaw=np.zeros(1), pitch=np.zeros(1))


def look(simulator):
    print("sees", round(float(simulator.render(pose, camera, rgb=False).depth.max()), 2), flush=True)


"""
PLAIN = """
import os, signal, sys
from pathlib import Path
import numpy as np
from avp_habitat.poses import Intrinsics
from avp_habitat.scenes.location import Frame, locate
from avp_habitat.simulators.habitat.engine import HabitatEngine
from avp_habitat.simulators.habitat.stage import write_stage

room, folder = sys.argv[1], Path(sys.argv[2])
camera = Intrinsics.from_hfov(16, 12, hfov_deg=90.0)


def plain(gpu=-1):
    engine = HabitatEngine(*write_stage(locate(room), Frame(), folder), gpu=gpu)
    print("opened", flush=True)
    return engine


def look(engine):
    print("sees", engine.render(np.eye(4)[None], camera, rgb=False).depth.shape, flush=True)


"""


@pytest.fixture
def run(tmp_path):
    """Runs code with the suite's guards, or with Habitat-Sim's engine alone; both get a furnished room."""

    def run_code(before: str, code: str, **environment: str) -> "subprocess.CompletedProcess[str]":
        room = write_room(tmp_path / "room" / "room.glb", furnished()) if not list(tmp_path.glob("room/*")) else None
        room = room or tmp_path / "room/room.glb"
        stage = tmp_path / "stage"
        stage.mkdir(exist_ok=True)
        return subprocess.run(
            [sys.executable, "-c", before + code, str(room), str(stage)],
            cwd=ROOT,
            env={**os.environ, **environment},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )

    return run_code


def expect_error(done: "subprocess.CompletedProcess[str]", text: str) -> None:
    """One line of ours and exit code 1, as every command of the suite ends."""
    assert done.returncode == 1, done.stderr
    assert "Traceback" not in done.stderr
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert text in line


def expect_death(done: "subprocess.CompletedProcess[str]", said: str, *codes: int) -> None:
    """Not by a Python exception."""
    assert done.returncode in codes, (done.returncode, done.stderr)
    assert "Traceback" not in done.stderr
    assert said in done.stderr
    assert "survived" not in done.stdout


def command(code: str) -> str:
    body = "".join(f"    {line}\n" for line in code.splitlines())
    return f"def main(_):\n{body}\nsys.exit(command.run(main))\n"


# --- no such device, no EGL -------------------------------------------------------------------------------------------


@pytest.mark.skipif(bool(inspect_graphics().cuda_numbers), reason="EGL offers a CUDA device here")
def test_a_missing_cuda_device_is_an_error_of_ours(run):
    expect_error(run(GUARDED, command("HabitatSimulator(room, gpu=0)")), "there is no CUDA device 0: EGL offers none")
    # Habitat-Sim's own default, 0.
    expect_death(run(PLAIN, "plain(gpu=0); print('survived')"), "unable to find CUDA device 0", 1)
    assert "sees" in run(GUARDED, command("look(HabitatSimulator(room))")).stdout


def test_egl_that_cannot_be_loaded_is_an_error_of_ours(run, tmp_path):
    (tmp_path / "libEGL.so.1").write_text("not a library")
    done = run(GUARDED, command("HabitatSimulator(room)"), LD_LIBRARY_PATH=str(tmp_path))
    expect_error(done, "Debian, Ubuntu: apt-get install libegl1")


def test_egl_without_a_driver_is_an_error_of_ours(run, tmp_path):
    nothing = {"__EGL_VENDOR_LIBRARY_FILENAMES": str(tmp_path / "nothing.json")}
    done = run(GUARDED, command("HabitatSimulator(room)"), **nothing)
    expect_error(done, "habitat: no OpenGL on EGL's first device")
    # What Habitat-Sim says of it is lost with the process: the engine holds its words back while it opens.
    expect_death(run(PLAIN, "plain(); print('survived')", **nothing), "", 1)


# --- no NavMesh -------------------------------------------------------------------------------------------------------


def test_a_pathfinder_without_a_navmesh_is_never_asked(run, tmp_path):
    write_room(tmp_path / "room" / "room.glb", [([(0, 0, 0), (1, 0, 0), (1, 2, 0), (0, 2, 0)], (0.5, 0.5, 0.5))])
    expect_error(
        run(GUARDED, command("HabitatSimulator(room)")), "room.glb: Habitat-Sim found no floor for its NavMesh"
    )
    code = (
        "engine = plain()\nprint(engine._sim.pathfinder.is_loaded, flush=True)\n"
        "engine._sim.pathfinder.navigable_area\nprint('survived')"
    )
    done = run(PLAIN, code)
    assert "False" in done.stdout
    expect_death(done, "", -signal.SIGSEGV)


DAMAGED = """
import habitat_sim
from avp_habitat.errors import SceneError
from avp_habitat.navigation.navmesh import read_navmesh
from avp_habitat.navigation.settings import NavigationSettings

engine = plain()
engine.recompute_navmesh(NavigationSettings())
whole, damaged = folder / "whole.navmesh", folder / "damaged.navmesh"
assert engine._sim.pathfinder.save_nav_mesh(str(whole))
areas = [
    sorted(round(float(np.linalg.norm(np.cross(t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]), axis=1).sum()), 3) for t in parts)
    for parts in (engine.islands(), read_navmesh(whole).islands)
]
assert areas[0] == areas[1], areas
engine.close()
content, rng = whole.read_bytes(), np.random.default_rng(0)


def refused():
    try:
        found = read_navmesh(damaged)
    except SceneError as error:
        assert "damaged.navmesh: expected a NavMesh" in str(error)
        return True
    assert all(np.isfinite(part).all() for part in found.islands)
    return False


def is_deadly():
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        signal.alarm(10)
        finder = habitat_sim.PathFinder()
        if finder.load_nav_mesh(str(damaged)) and finder.is_loaded:
            for island in range(finder.num_islands):
                finder.build_navmesh_vertices(island), finder.build_navmesh_vertex_indices(island)
        os._exit(0)
    return os.waitpid(child, 0)[1] != 0


def damage(trial):
    changed = bytearray(content)
    if trial % 4 == 0:
        del changed[rng.integers(len(changed)) :]
    elif trial % 4 == 1:
        at = 4 * rng.integers(50)
        changed[at : at + 4] = int(rng.choice([0, -1, 7, 2**31 - 1])).to_bytes(4, "little", signed=True)
    else:
        for place in rng.integers(len(changed) if trial % 4 == 2 else 220, size=3):
            changed[place] = rng.integers(256)
    return bytes(changed)


seen = []
for trial in range(250):
    damaged.write_bytes(damage(trial))
    seen.append((refused(), is_deadly()))
print(sum(a for a, _ in seen), sum(b for _, b in seen))
"""


def test_a_damaged_navmesh_that_ends_habitat_sim_is_read_here_without_harm(run):
    done = run(PLAIN, DAMAGED)
    assert done.returncode == 0, done.stderr
    refused, deadly = map(int, done.stdout.splitlines()[-1].split())
    # Habitat-Sim does die of such files; and not every change is one that matters.
    assert deadly > 20
    assert 60 < refused < 250


# --- a second simulator, a fork, another thread -----------------------------------------------------------------------


def test_a_second_simulator_is_an_error_of_ours(run):
    done = run(
        GUARDED,
        command("first = HabitatSimulator(room)\ntry:\n    HabitatSimulator('builtin:0')\nfinally:\n    look(first)"),
    )
    expect_error(done, "one simulator, and this one has room.glb open already, so that builtin:0 needs a process")
    assert "SubprocVecEnv" in done.stderr
    assert "sees" in done.stdout
    # Two of 0.3.4 do open and render, until the first is closed: it takes the graphics of both along.
    code = "first, second = plain(), plain()\nlook(first); look(second)\nfirst.close()\nlook(second)\nprint('survived')"
    done = run(PLAIN, code)
    assert done.stdout.count("sees") == 2
    expect_death(done, "no current context", -signal.SIGABRT)


def test_a_forked_process_gets_an_error_of_ours_and_its_parent_goes_on(run):
    code = (
        "simulator = HabitatSimulator(room)\nlook(simulator)\nchild = os.fork()\n"
        "if child == 0:\n    try:\n        look(simulator)\n"
        "    except AVPError as error:\n        print('child:', error, flush=True)\n"
        "    HabitatSimulator('builtin:0')\nassert os.waitstatus_to_exitcode(os.wait()[1]) == 1\nlook(simulator)"
    )
    done = run(GUARDED, command(code))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("sees") == 2
    assert "child: habitat: room.glb cannot be used here: a simulator was opened in another" in done.stdout
    assert "error: habitat: builtin:0 cannot be used here: a simulator was opened in another" in done.stderr


def test_a_forked_process_dies_or_hangs_without_our_guard(run):
    opening = (
        "engine = plain()\nif os.fork() == 0:\n    plain(); print('survived'); os._exit(0)\n"
        "sys.exit(os.wait()[1] & 0x7F)"
    )
    done = run(PLAIN, opening)
    assert done.returncode == signal.SIGABRT, done.stderr
    assert "survived" not in done.stdout
    rendering = (
        "engine = plain()\nlook(engine)\nif os.fork() == 0:\n    signal.alarm(8); look(engine); os._exit(0)\n"
        "sys.exit(os.wait()[1] & 0x7F)"
    )
    done = run(PLAIN, rendering)
    assert done.returncode == signal.SIGALRM, "expected rendering after a fork to hang"
    assert done.stdout.count("sees") == 1


def test_a_simulator_that_is_closed_makes_room_for_the_next(run):
    code = (
        "for _ in range(3):\n    simulator = HabitatSimulator(room)\n    look(simulator)\n"
        "    simulator.close()\n    simulator.close()"
    )
    done = run(GUARDED, command(code))
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("sees") == 3
    assert len(set(done.stdout.splitlines())) == 1


# --- torch ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["before", "after", "loaded by hand"])
def test_torch_and_triton_live_with_the_simulator(run, order):
    pytest.importorskip("triton")
    torch = "import torch._dynamo, triton\n"
    simulator = "simulator = HabitatSimulator(room)\nlook(simulator)\n"
    code = {
        "before": torch + simulator,
        "after": simulator + torch + "look(simulator)",
        "loaded by hand": "import triton._C.libtriton\n" + simulator,
    }[order]
    done = run(GUARDED, command(code))
    assert done.returncode == 0, done.stderr
    assert "sees" in done.stdout


# --- the end of the process -------------------------------------------------------------------------------------------

STEPPING = """
from avp_habitat.task.env import AVPEnv
from avp_habitat.simulators.registry import make_simulator

env = AVPEnv(simulator=make_simulator("habitat", room), budget=30_000, width=64, height=48)
env.reset(seed=0)
"""
ENDINGS = {
    "left open": "env.step(0)",
    "left open in a circle": "circle = [env]\ncircle.append(circle)\ndel env",
    "an exception": "env.step(0)\nraise AVPError('enough')",
    "sys.exit": "env.step(0)\nsys.exit(3)",
}


@pytest.mark.parametrize(("ending", "code"), list(zip(ENDINGS, (0, 0, 1, 3), strict=True)))
def test_the_interpreter_ends_cleanly_with_a_simulator_left_open(run, ending, code):
    done = run(GUARDED, command(STEPPING + ENDINGS[ending]))
    assert done.returncode == code, done.stderr
    complaints = [line for line in done.stderr.splitlines() if not line.startswith("PluginManager::Manager")]
    assert complaints == (["error: enough"] if ending == "an exception" else [])


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_in_the_middle_of_stepping_ends_cleanly(tmp_path, sent):
    room = write_room(tmp_path / "room.glb", furnished())
    code = GUARDED + command(STEPPING + "print('stepping', flush=True)\nwhile True:\n    env.step(1)")
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(room)], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "stepping\n"
    time.sleep(0.5)
    process.send_signal(sent)
    _, complained = process.communicate(timeout=60)
    assert process.returncode == 130, complained
    assert "Traceback" not in complained
    assert complained.splitlines()[-1].startswith("interrupted")
