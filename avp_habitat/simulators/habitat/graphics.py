"""Which graphics device Habitat-Sim gets, asked of EGL beforehand: where none fits, Habitat-Sim ends the process.

Numbers of devices are those that EGL reports as `EGL_CUDA_DEVICE_NV`, which is what Habitat-Sim compares
`gpu_device_id` with; they are not the order of EGL's list. -1 does not ask for a CUDA device: Habitat-Sim then takes
the first device of EGL's list, which is Mesa's software renderer where there is no GPU.
"""

import functools
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from avp_habitat.errors import SimulatorError

FIRST_DEVICE = -1
# A driver that has to wake several GPUs takes seconds.
_TIME_LIMIT_S = 60.0
_PROBE = Path(__file__).with_name("egl_probe.py")
_INSTALL = (
    "Debian, Ubuntu: apt-get install libegl1 libopengl0 libgl1 libegl-mesa0 libgl1-mesa-dri; for a GPU also the "
    "driver's libnvidia-gl-<version>, in a container NVIDIA_DRIVER_CAPABILITIES=all"
)


@dataclass(frozen=True)
class GLContext:
    """An OpenGL context that could be made."""

    renderer: str
    """For example `"llvmpipe (LLVM 15.0.6, 256 bits)"`."""
    version: str
    """As the driver writes it."""


@dataclass(frozen=True)
class GraphicsState:
    """What EGL offers to this process."""

    devices: tuple[int | None, ...] = ()
    """In EGL's order: the number by which `--gpu` chooses it, None for a device that is not CUDA's."""
    context: GLContext | None = None
    """On the device that was asked for."""
    problem: str | None = None
    """Why there is no context or no list; None when all went well."""

    @property
    def cuda_numbers(self) -> tuple[int, ...]:
        """Numbers that `--gpu` can name, ascending."""
        return tuple(sorted(number for number in self.devices if number is not None))

    def index_of(self, gpu: int) -> int:
        """Place in EGL's list of the device that `gpu` names."""
        return 0 if gpu == FIRST_DEVICE else self.devices.index(gpu)


@functools.cache
def inspect_graphics(index: int | None = None) -> GraphicsState:
    """Ask EGL in a process of its own, once per process: 0.03 s for the list, 0.2 s with a context on Mesa.

    Args:
        index: also make an OpenGL context on the device at this place of EGL's list.
    """
    command = [sys.executable, "-I", "-S", str(_PROBE)] + ([] if index is None else [str(index)])
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_TIME_LIMIT_S, stdin=subprocess.DEVNULL, check=True
        )
    except subprocess.SubprocessError as error:
        return GraphicsState(problem=f"the graphics driver ended or did not answer: {error}")
    answer = json.loads(done.stdout)
    context = answer["context"] and GLContext(**answer["context"])
    return GraphicsState(tuple(answer["devices"]), context, answer["problem"])


def choose_gpu(gpu: int | None) -> int:
    """The device number to give to Habitat-Sim, on which an OpenGL context has really been made.

    Args:
        gpu: None chooses: the first CUDA device that EGL offers, else -1. -1 is EGL's first device (software rendering
            where there is no GPU). 0 and above is that CUDA device.

    Raises:
        SimulatorError: EGL is absent, has no such device, or makes no OpenGL context on it.
    """
    state = inspect_graphics()
    offered = state.cuda_numbers
    chosen = _automatic(offered, os.environ.get("CUDA_VISIBLE_DEVICES", "")) if gpu is None else gpu
    if chosen != FIRST_DEVICE and chosen not in offered:
        there = ", ".join(map(str, offered)) or "none"
        reason = f" ({state.problem})" if state.problem else ""
        raise SimulatorError(
            f"habitat: there is no CUDA device {chosen}: EGL offers {there}{reason}; use --gpu -1 for software "
            f"rendering; {_INSTALL}"
        )
    state = inspect_graphics(state.index_of(chosen))
    if state.context is None:
        device = "EGL's first device" if chosen == FIRST_DEVICE else f"CUDA device {chosen}"
        raise SimulatorError(f"habitat: no OpenGL on {device}: {state.problem}; {_INSTALL}")
    return chosen


def _automatic(offered: tuple[int, ...], visible: str) -> int:
    """The first that `CUDA_VISIBLE_DEVICES` names and EGL offers, else EGL's lowest: some drivers may renumber."""
    named = [int(part) for part in visible.split(",") if part.strip().isdecimal()]
    return next((number for number in (*named, *offered) if number in offered), FIRST_DEVICE)
