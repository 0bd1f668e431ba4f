"""Which graphics device Habitat-Sim gets, asked of EGL beforehand: where none fits, Habitat-Sim ends the process.

Numbers of devices are those that EGL reports as `EGL_CUDA_DEVICE_NV`, which is what Habitat-Sim compares
`gpu_device_id` with; they are not the order of EGL's list. `CUDA_VISIBLE_DEVICES` is CUDA's: EGL lists every GPU that
the container or the user's rights let it open. Whether NVIDIA's driver renumbers them by it has not been seen: its
extension only promises numbers "compatible with" CUDA's functions, and no machine with several GPUs was at hand. So the
probe runs in this process's environment, as the simulator will, and the automatic choice is right either way.
-1 does not ask for a CUDA device: Habitat-Sim then takes the first device of EGL's list, which is Mesa's software
renderer where there is no GPU.
"""

import functools
import json
import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat.errors import SimulatorError, UsageError

FIRST_DEVICE = -1
LEAST_OPENGL = (3, 3)
# A driver that has to wake several GPUs takes seconds.
_TIME_LIMIT_S = 60.0
_PROBE = Path(__file__).with_name("egl_probe.py")
_SOFTWARE = "apt-get install libegl1 libopengl0 libgl1 libegl-mesa0 libgl1-mesa-dri"
_NVIDIA = (
    "for NVIDIA's: the driver's EGL (Debian, Ubuntu: libnvidia-gl-<driver version>); in a container "
    "NVIDIA_DRIVER_CAPABILITIES=all"
)


@dataclass(frozen=True)
class EGLDevice:
    """One device of EGL's list."""

    cuda: int | None
    """The number by which `--gpu` chooses it; None for a device that is not CUDA's."""
    file: str | None
    """Its file, for example `/dev/dri/card0`."""
    software: bool
    """Whether the processor renders (Mesa's llvmpipe)."""
    accessible: bool
    """Whether this user may open it."""


@dataclass(frozen=True)
class GLContext:
    """An OpenGL context that could be made."""

    renderer: str
    """For example `"llvmpipe (LLVM 15.0.6, 256 bits)"`."""
    version: str
    """As the driver writes it."""
    number: tuple[int, int]
    """The version as numbers."""


@dataclass(frozen=True)
class GraphicsState:
    """What EGL offers to this process."""

    loads: bool
    """Whether libEGL.so.1 can be loaded."""
    devices: tuple[EGLDevice, ...]
    """In EGL's order; empty also where EGL has only its default display."""
    context: GLContext | None
    """The context on the device that was asked for."""
    problem: str | None
    """Why there is no context or no list, in EGL's words; None when all went well."""

    @property
    def cuda_numbers(self) -> tuple[int, ...]:
        """Numbers that `--gpu` can name, ascending."""
        return tuple(sorted(device.cuda for device in self.devices if device.cuda is not None))

    def index_of(self, gpu: int) -> int:
        """Place in EGL's list of the device that `gpu` names."""
        if gpu == FIRST_DEVICE:
            return 0
        return [device.cuda for device in self.devices].index(gpu)


@functools.cache
def inspect_graphics(index: int | None = None) -> GraphicsState:
    """Ask EGL in a process of its own, once per process: 0.03 s for the list, 0.2 s with a context on Mesa.

    Args:
        index: also make an OpenGL context on the device at this place of EGL's list.
    """
    command = [sys.executable, "-I", "-S", str(_PROBE)] + ([] if index is None else [str(index)])
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_TIME_LIMIT_S, stdin=subprocess.DEVNULL, check=False
        )
    except subprocess.TimeoutExpired:
        return GraphicsState(True, (), None, f"the graphics driver did not answer within {_TIME_LIMIT_S:.0f} s")
    if done.returncode != 0:
        return GraphicsState(True, (), None, _ended(done))
    return _state(json.loads(done.stdout), done.stderr)


def choose_gpu(gpu: int | None) -> int:
    """The device number to give to Habitat-Sim, on which an OpenGL context has really been made.

    Args:
        gpu: None chooses: the first CUDA device that EGL offers, else -1. -1 is EGL's first device (software rendering
            where there is no GPU). 0 and above is that CUDA device.

    Raises:
        UsageError: `gpu` is not such a number.
        SimulatorError: EGL is absent, has no such device, or no OpenGL 3.3 context can be made on it.
    """
    if gpu is not None:
        _check_number(gpu)
    state = inspect_graphics()
    if not state.loads:
        raise SimulatorError(
            f"habitat: no EGL, through which Habitat-Sim renders ({state.problem}); Debian, Ubuntu, for rendering "
            f"without a GPU: {_SOFTWARE}; {_NVIDIA}"
        )
    chosen = _automatic(state, os.environ.get("CUDA_VISIBLE_DEVICES")) if gpu is None else gpu
    if chosen != FIRST_DEVICE and chosen not in state.cuda_numbers:
        raise SimulatorError(_no_such_device(chosen, state))
    _check_context(chosen, inspect_graphics(state.index_of(chosen)))
    return chosen


def _check_number(gpu: int) -> None:
    if isinstance(gpu, bool) or not isinstance(gpu, int) or gpu < FIRST_DEVICE:
        raise UsageError(f"--gpu {gpu}: expected the number of a CUDA device, or -1 for rendering without a GPU")


def _automatic(state: GraphicsState, visible: str | None) -> int:
    """The first device of `CUDA_VISIBLE_DEVICES` where EGL lists more devices than that; else EGL's lowest number.

    A driver that renumbers lists just as many devices as are visible, from 0 on; one that does not lists all.
    """
    offered = state.cuda_numbers
    if not offered:
        return FIRST_DEVICE
    if visible is not None and visible.strip() in ("", "-1"):
        return FIRST_DEVICE  # CUDA's way to hide all GPUs
    numbers = [int(part) for part in (visible or "").split(",") if part.strip().isdecimal()]
    if numbers and len(numbers) < len(offered) and set(numbers) <= set(offered):
        return numbers[0]
    return offered[0]


def _no_such_device(gpu: int, state: GraphicsState) -> str:
    offered = ", ".join(map(str, state.cuda_numbers))
    closed = sum(not device.accessible for device in state.devices)
    rights = f" ({closed} that this user may not open)" if closed else ""
    there = f"EGL offers {offered}{rights}" if offered else f"EGL offers none{rights}"
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    note = f" (--gpu takes EGL's numbers; CUDA_VISIBLE_DEVICES={visible} is set)" if visible and offered else ""
    reason = f"; {state.problem}" if state.problem else ""
    driver = "" if offered else f"; {_NVIDIA}"
    return f"habitat: there is no CUDA device {gpu}: {there}{note}{reason}; use --gpu -1 for software rendering{driver}"


def _check_context(gpu: int, state: GraphicsState) -> None:
    device = "EGL's first device" if gpu == FIRST_DEVICE else f"CUDA device {gpu}"
    other = f"for rendering without a GPU: {_SOFTWARE}" if gpu == FIRST_DEVICE else "try --gpu -1"
    if state.context is None:
        raise SimulatorError(f"habitat: no OpenGL on {device}: {state.problem}; {other}")
    if state.context.number < LEAST_OPENGL:
        raise SimulatorError(
            f"habitat: {device} ({state.context.renderer}) gives OpenGL {state.context.version}, and Habitat-Sim's "
            f"shaders need 3.3; {other}"
        )


def _ended(done: "subprocess.CompletedProcess[str]") -> str:
    how = f"with exit code {done.returncode}"
    if done.returncode < 0:
        how = f"by {signal.Signals(-done.returncode).name}"
    return f"the graphics driver ended the process that asked it, {how}{_last_line(done.stderr)}"


def _last_line(stderr: str) -> str:
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    return f" ({lines[-1]})" if lines else ""


def _state(answer: dict[str, Any], stderr: str) -> GraphicsState:
    devices = tuple(
        EGLDevice(entry["cuda"], entry["file"], entry["software"], entry["accessible"]) for entry in answer["devices"]
    )
    context = answer["context"]
    made = context and GLContext(context["renderer"], context["version"], (context["number"][0], context["number"][1]))
    problem = answer["error"]
    return GraphicsState(answer["loads"], devices, made, problem and f"{problem}{_last_line(stderr)}")
