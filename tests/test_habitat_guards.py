"""What ends a process inside Habitat-Sim becomes a Python error before it happens."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import numpy as np
import pytest

from avp_habitat.errors import SimulatorError, UsageError
from avp_habitat.simulators.habitat import graphics
from avp_habitat.simulators.habitat.installed import cannot_load

ROOT = Path(__file__).resolve().parent.parent
OTHER_PYTHON = "habitat_sim_bindings.cpython-39-x86_64-linux-gnu.so"
THIS_PYTHON = f"habitat_sim_bindings{sysconfig.get_config_var('EXT_SUFFIX')}"
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
print(json.dumps([found.version, found.built_for, error]))
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

    def make(version, *, extension=THIS_PYTHON, metadata=None, files=(), links=b"\0libEGL.so.1\0"):
        folder = tmp_path / "habitat_sim"
        (folder / "_ext").mkdir(parents=True)
        (folder / "__init__.py").write_text(f'import nothing_of_this_name\n__version__ = "{version}"\n')
        (folder / "_ext" / extension).write_bytes(b"\x7fELF" + links)
        for name in files:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).touch()
        if metadata:
            info = tmp_path / f"habitat_sim-{metadata}.dist-info"
            info.mkdir()
            (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: habitat-sim\nVersion: {metadata}\n")
        return tmp_path

    return make


def test_without_habitat_sim_the_error_says_how_to_get_it():
    assert looked_at()[2].startswith("habitat-sim is not installed")
    assert "build version 0.3.4 from its sources" in looked_at()[2]
    assert "reported to be for Python 3.9 only (its issue 2625)" in looked_at()[2]


def test_a_folder_of_that_name_without_code_is_not_habitat_sim(tmp_path):
    (tmp_path / "habitat_sim").mkdir()
    assert "is not installed" in looked_at(tmp_path)[2]


def test_the_version_comes_from_the_installed_metadata_before_the_source(package):
    assert looked_at(package("0.3.3", metadata="0.3.4"))[:2] == ["0.3.4", f"3.{sys.version_info.minor}"]


def test_a_source_build_that_calls_itself_0_3_3_is_told_from_0_3_4_by_its_files(package):
    version, _, error = looked_at(package("0.3.3", files=["sensors/sensor_wrapper.py"]))
    assert (version, error) == ("0.3.4", None)


@pytest.mark.skipif(int(np.__version__.split(".")[0]) < 2, reason="needs NumPy 2, with which these cannot be loaded")
@pytest.mark.parametrize("version", ["0.2.4", "0.3.1", "0.3.3"])
def test_versions_built_for_numpy_1_are_refused_with_numpy_2(package, version):
    error = looked_at(package(version))[2]
    assert f"habitat-sim {version} is installed but cannot run here: it was built for NumPy 1" in error
    assert np.__version__ in error
    assert 'pip install "numpy<2"' in error


def test_a_build_for_another_python_is_refused_and_says_for_which(package):
    version, built_for, error = looked_at(package("0.3.4", extension=OTHER_PYTHON))
    assert (version, built_for) == ("0.3.4", "3.9")
    assert f"it was built for Python 3.9 and this is Python 3.{sys.version_info.minor}" in error


def test_a_version_older_than_the_suite_supports_is_refused(package):
    assert "0.2.4 to 0.3.4, not 0.2.1" in looked_at(package("0.2.1"))[2]


def test_a_missing_graphics_library_is_named_with_its_debian_package(package, tmp_path):
    broken = tmp_path / "lib"
    broken.mkdir()
    (broken / "libOpenGL.so.0").write_bytes(b"not a library")
    folder = package("0.3.4", links=b"\0libEGL.so.1\0libOpenGL.so.0\0")
    done = run(LOOK, path=[folder], LD_LIBRARY_PATH=str(broken))
    error = json.loads(done.stdout)[2]
    assert "libOpenGL.so.0 cannot be loaded" in error
    assert "apt-get install libopengl0" in error


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (
            ImportError("libEGL.so.1: cannot open shared object file: No such file or directory"),
            "apt-get install libegl1",
        ),
        (ImportError("libfoo.so.3: cannot open shared object file"), "the package that holds libfoo.so.3"),
        (ImportError("numpy.core.multiarray failed to import"), f"another NumPy than the {np.__version__} here"),
        (ImportError("/lib/libstdc++.so.6: version `GLIBCXX_3.4.30' not found"), "libstdcxx-ng"),
        (ModuleNotFoundError("No module named 'quaternion'", name="quaternion"), "pip install numpy-quaternion"),
        (ModuleNotFoundError("No module named '_magnum'", name="_magnum"), "incomplete: it has no module _magnum"),
        (ImportError("undefined symbol:\n  _ZN5abc"), "cannot be loaded: undefined symbol: _ZN5abc; reinstall it"),
    ],
)
def test_an_import_error_of_habitat_sim_becomes_one_line_with_the_fix(error, expected):
    assert expected in cannot_load(error)
    assert "\n" not in cannot_load(error)


# --- graphics ---------------------------------------------------------------------------------------------------------

CHOOSE = """
import sys
from avp_habitat.errors import SimulatorError, UsageError
from avp_habitat.simulators.habitat.graphics import choose_gpu
try:
    print(choose_gpu(eval(sys.argv[1])))
except (SimulatorError, UsageError) as error:
    print(type(error).__name__, error)
"""
# An EGL with three devices: CUDA's 1, CUDA's 0, and one that may not be opened; making a display of one crashes.
FAKE_EGL = r"""
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
static int last = 0x3000;
int eglGetError(void) { int e = last; last = 0x3000; return e; }
const char* eglQueryString(void* d, int n) {
  return "EGL_EXT_device_base EGL_EXT_platform_base EGL_EXT_platform_device";
}
static unsigned devices(int max, void** out, int* count) {
  for (int i = 0; out && i < max && i < 3; i++) out[i] = (void*)(intptr_t)(i + 1);
  *count = 3; return 1;
}
static const char* string(void* d, int name) {
  if ((intptr_t)d == 3) { last = 0x322B; return 0; }
  return name == 0x3055 ? "EGL_NV_device_cuda EGL_EXT_device_drm" : "/dev/dri/card0";
}
static unsigned attribute(void* d, int name, intptr_t* out) {
  if ((intptr_t)d == 3) abort();
  *out = 2 - (intptr_t)d; return 1;
}
static void* display(unsigned p, void* d, const int* a) { abort(); }
void* eglGetProcAddress(const char* n) {
  if (!strcmp(n, "eglQueryDevicesEXT")) return devices;
  if (!strcmp(n, "eglQueryDeviceStringEXT")) return string;
  if (!strcmp(n, "eglQueryDeviceAttribEXT")) return attribute;
  if (!strcmp(n, "eglGetPlatformDisplayEXT")) return display;
  return 0;
}
void eglGetDisplay(void) {} void eglInitialize(void) {} void eglTerminate(void) {} void eglBindAPI(void) {}
void eglChooseConfig(void) {} void eglCreateContext(void) {} void eglMakeCurrent(void) {}
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
    assert renders.context.number >= (3, 3)
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


@pytest.mark.parametrize("gpu", [-2, 0.5, "0", True])
def test_a_device_that_cannot_be_a_number_is_a_mistake_of_usage(gpu):
    with pytest.raises(UsageError, match=r"--gpu .*: expected the number of a CUDA device, or -1"):
        graphics.choose_gpu(gpu)


def test_absent_egl_names_the_packages(tmp_path):
    (tmp_path / "libEGL.so.1").write_bytes(b"not a library")
    said = chosen(None, LD_LIBRARY_PATH=str(tmp_path))
    assert said.startswith("SimulatorError habitat: no EGL")
    assert "apt-get install libegl1 libopengl0 libgl1" in said


def test_egl_without_a_driver_is_an_error_and_not_a_crash():
    said = chosen(-1, __EGL_VENDOR_LIBRARY_FILENAMES="/nonexistent.json")
    assert said.startswith("SimulatorError habitat: no OpenGL on EGL's first device")
    assert "apt-get install" in said


def test_a_gpu_is_found_by_its_cuda_number_and_not_by_its_place(three_gpus):
    probe = str(Path(graphics.__file__).with_name("egl_probe.py"))
    done = subprocess.run(
        [sys.executable, "-I", "-S", probe],
        env={**os.environ, "LD_LIBRARY_PATH": three_gpus},
        capture_output=True,
        text=True,
        check=True,
    )
    devices = json.loads(done.stdout)["devices"]
    assert [device["cuda"] for device in devices] == [1, 0, None]
    assert [device["accessible"] for device in devices] == [True, True, False]
    assert devices[0]["file"] == "/dev/dri/card0"


def test_the_devices_that_are_there_are_named(three_gpus):
    said = chosen(5, LD_LIBRARY_PATH=three_gpus)
    assert "no CUDA device 5: EGL offers 0, 1 (1 that this user may not open)" in said


def test_a_driver_that_crashes_is_an_error_that_names_the_signal(three_gpus):
    said = chosen(1, LD_LIBRARY_PATH=three_gpus)
    assert "no OpenGL on CUDA device 1: the graphics driver ended the process that asked it, by SIGABRT" in said


@pytest.mark.parametrize(
    ("offered", "visible", "expected"),
    [
        ((), None, -1),
        ((), "0", -1),
        ((0, 1, 2), None, 0),
        ((0, 1, 2), "2", 2),
        ((0, 1, 2), "2,1", 2),
        ((0,), "2", 0),  # a driver that renumbers
        ((3, 5), "GPU-8f1c", 3),
        ((0, 1), "", -1),
        ((0, 1), "-1", -1),
    ],
)
def test_the_automatic_choice_follows_what_cuda_may_see(offered, visible, expected):
    devices = tuple(graphics.EGLDevice(number, None, False, True) for number in offered)
    assert graphics._automatic(graphics.GraphicsState(True, devices, None, None), visible) == expected


# --- one per process --------------------------------------------------------------------------------------------------

FORK = """
import os, sys, threading
from avp_habitat.errors import SimulatorError
from avp_habitat.simulators.habitat import process

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
        "process.claim('kitchen')\n"
        "print(says(process.claim, 'hall')); print(process.release()); print(says(process.claim, 'hall'))"
    )
    assert "already has a simulator, on kitchen, so hall cannot be opened" in second
    assert 'SubprocVecEnv(start_method="forkserver")' in second
    assert (released, third) == ("True", "None")


def test_a_fork_of_a_process_without_a_simulator_may_open_one():
    child, parent = told("print(in_child(process.claim, 'hall')); print(says(process.claim, 'kitchen'))")
    assert (child, parent) == ("None", "None")


@pytest.mark.parametrize("closed", [False, True])
def test_a_fork_of_a_process_that_had_a_simulator_may_not_open_or_use_one(closed):
    opened, used, freed, parent = told(
        "process.claim('kitchen')\n"
        + ("process.release()\n" if closed else "")
        + "print(in_child(process.claim, 'hall')); print(in_child(process.check_process, 'kitchen'))\n"
        "print(in_child(process.release)); print(says(process.check_process, 'kitchen'))"
    )
    assert "hall cannot be used here: this process was forked from process" in opened
    assert 'SubprocVecEnv(start_method="forkserver")' in opened
    assert "kitchen cannot be used here: this process was forked" in used
    assert (freed, parent) == ("False", "None")


def test_another_thread_may_not_use_the_simulator():
    (said,) = told(
        "process.claim('kitchen')\n"
        "thread = threading.Thread(target=lambda: print(says(process.check_process, 'kitchen')))\n"
        "thread.start(); thread.join()"
    )
    assert "kitchen was opened in another thread" in said


ORDER = """
import sys
from avp_habitat.errors import SimulatorError
from avp_habitat.simulators.habitat.process import import_before_graphics
before = set(sys.modules)
try:
    import_before_graphics()
except SimulatorError as error:
    print(error)
print("torch" in sys.modules, "triton._C.libtriton" in sys.modules, sys.getdlopenflags())
"""


def test_triton_is_loaded_before_the_graphics_and_torch_is_not():
    pytest.importorskip("triton")
    assert run(ORDER).stdout.split() == ["False", "True", str(sys.getdlopenflags())]


def test_triton_after_habitat_sim_is_an_error_before_it_is_a_crash(tmp_path):
    pytest.importorskip("triton")
    (tmp_path / "corrade").mkdir()
    (tmp_path / "corrade" / "__init__.py").touch()
    late = run("import corrade, triton._C.libtriton\n" + ORDER, path=[tmp_path]).stdout
    early = run("import triton._C.libtriton, corrade\n" + ORDER, path=[tmp_path]).stdout
    assert "triton (part of torch) was imported after habitat_sim" in late
    assert early.split() == ["False", "True", str(sys.getdlopenflags())]


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
        ("sim = HabitatSimulator('builtin:0')\ntried(HabitatSimulator, 'builtin:1')", "already has a simulator, on"),
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
@pytest.mark.parametrize("before", ["", "import magnum, habitat_sim\n"])
def test_torch_dynamo_can_be_imported_after_a_simulator(before):
    pytest.importorskip("torch")
    done = simulated(
        before + "HabitatSimulator('builtin:0').close()\n"
        "sim = HabitatSimulator('builtin:0')\nimport torch._dynamo\nlook(sim)"
    )
    assert done.returncode == 0, done.stderr
    assert "(1, 12, 16)" in done.stdout
