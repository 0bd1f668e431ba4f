"""What EGL offers on this machine, as one JSON object; a program of its own, because drivers may crash when asked.

    python -I -S egl_probe.py            the CUDA numbers of the devices, null for those that are not CUDA's
    python -I -S egl_probe.py INDEX      also the OpenGL of the device at this place of the list

It asks for what Habitat-Sim (its library Magnum) asks for: device INDEX of `eglQueryDevicesEXT`, a config that can draw
to a pbuffer, a context that is current without a surface. Neither the suite nor Habitat-Sim is imported.
"""

import json
import sys
from ctypes import CDLL, CFUNCTYPE, byref, c_char_p, c_int, c_ssize_t, c_uint, c_void_p
from typing import Any

_CUDA_DEVICE = 0x323A
_OPENGL_API = 0x30A2
_PBUFFER_AND_OPENGL = (0x3033, 0x0001, 0x3040, 0x0008, 0x3038)
_PLATFORM_DEVICE = 0x313F
_RENDERER, _VERSION = 0x1F01, 0x1F02
_MOST_DEVICES = 64


def function(name: str, result: Any = c_uint) -> Any:
    """A function of EGL or OpenGL that takes values of ctypes; OSError where there is no EGL, or none that has it."""
    find = CDLL("libEGL.so.1").eglGetProcAddress
    find.restype = c_void_p
    address = find(name.encode())
    if not address:
        raise OSError(f"EGL has no {name}")
    return CFUNCTYPE(result)(address)


def call(name: str, *arguments: Any, result: Any = c_uint) -> Any:
    """What a function gives; OSError where that is 0, by which EGL says that it failed."""
    given = function(name, result)(*arguments)
    if not given:
        raise OSError(f"{name} failed with EGL error 0x{function('eglGetError')():04X}")
    return given


def devices() -> list[c_void_p]:
    """Handles, in EGL's order."""
    handles, count = (c_void_p * _MOST_DEVICES)(), c_int()
    call("eglQueryDevicesEXT", _MOST_DEVICES, handles, byref(count))
    return [c_void_p(handle) for handle in handles[: count.value]]


def cuda_number(device: c_void_p) -> int | None:
    """By which CUDA knows a device."""
    number = c_ssize_t()
    return number.value if function("eglQueryDeviceAttribEXT")(device, _CUDA_DEVICE, byref(number)) else None


def opengl(device: c_void_p) -> dict[str, str]:
    """Renderer and version that a device gives."""
    display = c_void_p(call("eglGetPlatformDisplayEXT", _PLATFORM_DEVICE, device, None, result=c_void_p))
    call("eglInitialize", display, None, None)
    call("eglBindAPI", _OPENGL_API)
    wanted, config, count = (c_int * 5)(*_PBUFFER_AND_OPENGL), c_void_p(), c_int()
    call("eglChooseConfig", display, wanted, byref(config), 1, byref(count))
    context = c_void_p(call("eglCreateContext", display, config, None, None, result=c_void_p))
    call("eglMakeCurrent", display, None, None, context)
    named = {"renderer": _RENDERER, "version": _VERSION}
    return {name: call("glGetString", number, result=c_char_p).decode() for name, number in named.items()}


def main(index: int | None) -> None:
    """Print what can be found out, and as `problem` why not all could."""
    answer: dict[str, Any] = {"devices": [], "context": None, "problem": None}
    try:
        found = devices()
        answer["devices"] = [cuda_number(device) for device in found]
        if index is not None and index >= len(found):
            raise OSError(f"EGL lists {len(found)} devices")
        if index is not None:
            answer["context"] = opengl(found[index])
    except OSError as error:
        answer["problem"] = str(error)
    print(json.dumps(answer))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else None)
