"""What ends a process inside Habitat-Sim becomes a Python error before it happens."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from avp_habitat.errors import SimulatorError
from avp_habitat.simulators.habitat import graphics

ROOT = Path(__file__).resolve().parent.parent
LOOK = """
import json, sys
from avp_habitat.simulators.habitat.installed import inspect_installation, require_installed
from avp_habitat.errors import SimulatorError
found = inspect_installation()
error = None
try:
    require_installed()
except SimulatorError as e:
    error = str(e)
assert not {"habitat_sim", "magnum", "torch"} & set(sys.modules)
print(json.dumps([found.version, error]))
"""


def run(code, *arguments, path=(), **environment):
    """Finished process of a program text that can import the suite and what lies in `path`."""
    found = os.pathsep.join(map(str, (*path, ROOT)))
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": found, **environment},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def looked_at(*path):
    done = run(LOOK, path=path)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture
def package(tmp_path):
    """Makes a folder that looks like an installed habitat-sim of a version, up to what importing it would need."""

    def make(version, *, files=()):
        folder = tmp_path / "habitat_sim"
        folder.mkdir()
        (folder / "__init__.py").write_text(f'import nothing_of_this_name\n__version__ = "{version}"\n')
        for name in files:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).touch()
        return tmp_path

    return make


def test_without_habitat_sim_the_error_says_how_to_get_it():
    assert looked_at()[1].startswith("habitat-sim is not installed")
    assert "build version 0.3.4 from its sources" in looked_at()[1]
    assert "reported to be for Python 3.9 only (its issue 2625)" in looked_at()[1]


def test_a_folder_of_that_name_without_code_is_not_habitat_sim(tmp_path):
    (tmp_path / "habitat_sim").mkdir()
    assert "is not installed" in looked_at(tmp_path)[1]


def test_a_source_build_that_calls_itself_0_3_3_is_told_from_0_3_4_by_its_files(package):
    assert looked_at(package("0.3.3", files=["sensors/sensor_wrapper.py"])) == ["0.3.4", None]


@pytest.mark.skipif(int(np.__version__.split(".")[0]) < 2, reason="needs NumPy 2, with which these cannot be loaded")
@pytest.mark.parametrize("version", ["0.2.4", "0.3.1", "0.3.3"])
def test_versions_built_for_numpy_1_are_refused_with_numpy_2(package, version):
    error = looked_at(package(version))[1]
    assert f"habitat-sim {version} is installed but cannot run here: it was built for NumPy 1" in error
    assert np.__version__ in error
    assert 'pip install "numpy<2"' in error


IMPORT = """
import sys
from avp_habitat.errors import SimulatorError
from avp_habitat.simulators.habitat.engine import _import_habitat
flags = sys.getdlopenflags()
try:
    _import_habitat()
except SimulatorError as error:
    print(error)
assert sys.getdlopenflags() == flags
print("torch" in sys.modules, "triton._C.libtriton" in sys.modules)
"""


def test_an_import_error_of_habitat_sim_becomes_one_line_with_what_it_needs(package, tmp_path):
    (tmp_path / "magnum.py").touch()
    said = run(IMPORT, path=[package("0.3.4")]).stdout.splitlines()
    assert len(said) == 2
    assert "installed but cannot be loaded: No module named 'nothing_of_this_name'; it has to be built for" in said[0]
    assert f"NumPy {np.__version__}" in said[0]
    assert "apt-get install libegl1" in said[0]


def test_triton_is_loaded_before_the_graphics_and_torch_is_not():
    pytest.importorskip("triton")
    assert run(IMPORT).stdout.splitlines()[-1] == "False True"


# --- graphics ---------------------------------------------------------------------------------------------------------

CHOOSE = """
import sys
from avp_habitat.errors import SimulatorError
from avp_habitat.simulators.habitat.graphics import choose_gpu
try:
    print(choose_gpu(eval(sys.argv[1])))
except SimulatorError as error:
    print(error)
"""
# An EGL with three devices: CUDA's 1, CUDA's 0, and one that is not CUDA's; making a display of one crashes.
FAKE_EGL = r"""
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
static unsigned devices(int max, void** out, int* count) {
  for (int i = 0; i < 3; i++) out[i] = (void*)(intptr_t)(i + 1);
  *count = 3; return 1;
}
static unsigned attribute(void* d, int name, intptr_t* out) {
  *out = 2 - (intptr_t)d; return (intptr_t)d < 3;
}
static void* display(unsigned p, void* d, const int* a) { abort(); }
void* eglGetProcAddress(const char* n) {
  if (!strcmp(n, "eglQueryDevicesEXT")) return devices;
  if (!strcmp(n, "eglQueryDeviceAttribEXT")) return attribute;
  if (!strcmp(n, "eglGetPlatformDisplayEXT")) return display;
  return 0;
}
"""


def chosen(gpu, **environment):
    done = run(CHOOSE, gpu, **environment)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.fixture(scope="module")
def three_gpus(tmp_path_factory):
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler for a libEGL that has GPUs")
    folder = tmp_path_factory.mktemp("egl")
    (folder / "egl.c").write_text(FAKE_EGL)
    subprocess.run([compiler, "-shared", "-fPIC", "-o", "libEGL.so.1", "egl.c"], cwd=folder, check=True)
    return str(folder)


@pytest.fixture
def renders():
    state = graphics.inspect_graphics(0)
    if state.context is None:
        pytest.skip(f"no OpenGL on EGL's first device: {state.problem}")
    return state


def test_the_probe_makes_the_context_that_habitat_sim_would_make(renders):
    assert int(renders.context.version[0]) >= 3
    assert renders.context.renderer


def test_without_a_cuda_device_the_choice_is_minus_one(renders):
    state = graphics.inspect_graphics()
    if state.cuda_numbers:
        pytest.skip(f"EGL offers CUDA devices {state.cuda_numbers}")
    assert graphics.choose_gpu(None) == -1


def test_minus_one_can_always_be_asked_for(renders):
    assert graphics.choose_gpu(-1) == -1


def test_a_cuda_device_that_is_not_there_is_refused_with_the_way_out():
    with pytest.raises(SimulatorError, match=r"no CUDA device 99: EGL offers .*use --gpu -1 for software rendering"):
        graphics.choose_gpu(99)


def test_absent_egl_names_the_packages(tmp_path):
    (tmp_path / "libEGL.so.1").write_bytes(b"not a library")
    said = chosen(None, LD_LIBRARY_PATH=str(tmp_path))
    assert said.startswith("habitat: no OpenGL on EGL's first device: ")
    assert "libEGL.so.1" in said
    assert "apt-get install libegl1 libopengl0 libgl1" in said


def test_egl_without_a_driver_is_an_error_and_not_a_crash():
    said = chosen(-1, __EGL_VENDOR_LIBRARY_FILENAMES="/nonexistent.json")
    assert said.startswith("habitat: no OpenGL on EGL's first device: EGL lists 0 devices")
    assert "apt-get install" in said


def test_the_devices_that_are_there_are_named(three_gpus):
    assert "no CUDA device 5: EGL offers 0, 1; use --gpu -1" in chosen(5, LD_LIBRARY_PATH=three_gpus)


def test_a_gpu_is_found_by_its_cuda_number_and_a_driver_that_crashes_is_named_with_the_signal(three_gpus):
    said = chosen(0, LD_LIBRARY_PATH=three_gpus)
    assert re.search(r"no OpenGL on CUDA device 0: the graphics driver .*egl_probe.py', '1'.*SIGABRT", said)


@pytest.mark.parametrize(
    ("offered", "visible", "expected"),
    [
        ((), "", -1),
        ((), "0", -1),
        ((0, 1, 2), "", 0),
        ((0, 1, 2), "2", 2),
        ((0, 1, 2), "2,1", 2),
        ((0,), "2", 0),  # a driver that renumbers
        ((3, 5), "GPU-8f1c", 3),
    ],
)
def test_the_automatic_choice_follows_what_cuda_may_see(offered, visible, expected):
    assert graphics._automatic(offered, visible) == expected


# --- one per process --------------------------------------------------------------------------------------------------

FORK = """
import os, sys, threading
from avp_habitat.errors import SimulatorError
from avp_habitat.simulators.habitat.simulator import _check_process, _claim, _release

def says(function, *arguments):
    try:
        return repr(function(*arguments))
    except SimulatorError as error:
        return str(error)

def in_child(function, *arguments):
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writing, says(function, *arguments).encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(writing)
    return os.read(reading, 5000).decode()

"""


def told(code):
    done = run(FORK + code)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_a_second_simulator_is_refused_by_both_scenes_names_and_the_first_can_be_closed():
    second, released, third = told(
        "_claim('kitchen')\nprint(says(_claim, 'hall')); print(_release()); print(says(_claim, 'hall'))"
    )
    assert "a process can hold one simulator, and this one has kitchen open already, so that hall needs" in second
    assert 'SubprocVecEnv(start_method="forkserver")' in second
    assert (released, third) == ("True", "None")


def test_a_fork_of_a_process_without_a_simulator_may_open_one():
    child, parent = told("print(in_child(_claim, 'hall')); print(says(_claim, 'kitchen'))")
    assert (child, parent) == ("None", "None")


@pytest.mark.parametrize("closed", [False, True])
def test_a_fork_of_a_process_that_had_a_simulator_may_not_open_or_use_one(closed):
    opened, used, freed, parent = told(
        "_claim('kitchen')\n"
        + ("_release()\n" if closed else "")
        + "print(in_child(_claim, 'hall')); print(in_child(_check_process, 'kitchen'))\n"
        "print(in_child(_release)); print(says(_check_process, 'kitchen'))"
    )
    assert re.search(r"hall cannot be used here: .* this process was forked from process \d", opened)
    assert 'SubprocVecEnv(start_method="forkserver")' in opened
    assert re.search(r"kitchen cannot be used here: .* this process was forked from process \d", used)
    assert (freed, parent) == ("False", "None")


def test_another_thread_may_not_use_the_simulator():
    (said,) = told(
        "_claim('kitchen')\n"
        "thread = threading.Thread(target=lambda: print(says(_check_process, 'kitchen')))\n"
        "thread.start(); thread.join()"
    )
    assert "kitchen cannot be used here: a simulator was opened in another thread" in said


# --- with the real simulator ------------------------------------------------------------------------------------------

OPEN = """
import os, sys, threading
from avp_habitat.errors import AVPError
from avp_habitat.simulators.habitat import HabitatSimulator

def tried(function, *arguments, **named):
    try:
        return function(*arguments, **named)
    except AVPError as error:
        print(type(error).__name__, error, flush=True)

"""
LOOK_ROUND = """
import numpy as np
from avp_habitat.poses import Intrinsics

def look(sim):
    pose = np.eye(4)
    pose[1, 3] = 1.5
    print(sim.render(pose[None], Intrinsics.from_hfov(16, 12, hfov_deg=90.0), rgb=False).depth.shape, flush=True)

"""


def simulated(code, **environment):
    return subprocess.run(
        [sys.executable, "-c", OPEN + LOOK_ROUND + code],
        env={**os.environ, **environment},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.mark.habitat
@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("tried(HabitatSimulator, 'builtin:0', gpu=99)", "SimulatorError habitat: there is no CUDA device 99"),
        (
            "sim = HabitatSimulator('builtin:0')\ntried(HabitatSimulator, 'builtin:1')",
            "a process can hold one simulator",
        ),
        (
            "sim = HabitatSimulator('builtin:0')\n"
            "if os.fork() == 0:\n    tried(look, sim); tried(HabitatSimulator, 'builtin:1'); os._exit(0)\n"
            "os.wait(); look(sim)",
            "this process was forked from process",
        ),
        (
            "sim = HabitatSimulator('builtin:0')\n"
            "thread = threading.Thread(target=lambda: tried(look, sim))\nthread.start(); thread.join()",
            "was opened in another thread",
        ),
    ],
)
def test_what_ends_habitat_sim_is_an_error_of_the_real_simulator(code, expected):
    done = simulated(code)
    assert done.returncode == 0, done.stderr
    assert expected in done.stdout


@pytest.mark.habitat
def test_torch_dynamo_can_be_imported_after_a_simulator():
    pytest.importorskip("torch")
    done = simulated(
        "HabitatSimulator('builtin:0').close()\nsim = HabitatSimulator('builtin:0')\nimport torch._dynamo\nlook(sim)"
    )
    assert done.returncode == 0, done.stderr
    assert "(1, 12, 16)" in done.stdout
