"""What EGL offers on this machine, as one JSON object; a program of its own, because drivers may crash when asked.

    python -I -S egl_probe.py            the devices
    python -I -S egl_probe.py INDEX      the devices, and an OpenGL context on the one of this index

It asks for what Habitat-Sim (its library Magnum) asks for, in the same order: device INDEX of `eglQueryDevicesEXT` or,
where EGL cannot list devices, the default display; a config that can draw to a pbuffer; a forward-compatible core
context, else a compatible one; made current without a surface. Habitat-Sim's shaders are written for OpenGL 3.3.
Only ctypes and the standard library: neither the suite nor Habitat-Sim is imported.
"""

import ctypes
import json
import re
import sys
from collections.abc import Callable
from typing import Any

_BAD_DEVICE = 0x322B
_CUDA_DEVICE = 0x323A
_CONTEXT_CLIENT_VERSION = 0x3098
_CONTEXT_FLAGS = 0x30FC
_DRM_DEVICE_FILE = 0x3233
_EXTENSIONS = 0x3055
_FORWARD_COMPATIBLE = 2
_NONE = 0x3038
_OPENGL_API = 0x30A2
_OPENGL_BIT = 0x0008
_PBUFFER_BIT = 0x0001
_PLATFORM_DEVICE = 0x313F
_RENDERABLE_TYPE = 0x3040
_SURFACE_TYPE = 0x3033
_VENDOR = 0x3053
_GL_VENDOR, _GL_RENDERER, _GL_VERSION = 0x1F00, 0x1F01, 0x1F02

_pointer, _int = ctypes.c_void_p, ctypes.c_int32


class ProbeError(Exception):
    """Something that EGL refused."""


class EGL:
    """libEGL by ctypes."""

    def __init__(self) -> None:
        """Load it; OSError when it is absent."""
        self.library = ctypes.CDLL("libEGL.so.1")
        self._address = self.library.eglGetProcAddress
        self._address.restype, self._address.argtypes = _pointer, [ctypes.c_char_p]
        self.error = self._core("eglGetError", _int)
        self.query_string = self._core("eglQueryString", ctypes.c_char_p, _pointer, _int)
        self.get_display = self._core("eglGetDisplay", _pointer, _pointer)
        self.initialize = self._core("eglInitialize", ctypes.c_uint, _pointer, _pointer, _pointer)
        self.terminate = self._core("eglTerminate", ctypes.c_uint, _pointer)
        self.bind_api = self._core("eglBindAPI", ctypes.c_uint, ctypes.c_uint)
        self.choose_config = self._core(
            "eglChooseConfig", ctypes.c_uint, _pointer, _pointer, _pointer, _int, ctypes.POINTER(_int)
        )
        self.create_context = self._core("eglCreateContext", _pointer, _pointer, _pointer, _pointer, _pointer)
        self.make_current = self._core("eglMakeCurrent", ctypes.c_uint, _pointer, _pointer, _pointer, _pointer)
        self.extensions = (self.query_string(None, _EXTENSIONS) or b"").decode(errors="replace").split()

    def _core(self, name: str, result: Any, *arguments: Any) -> Any:
        function = getattr(self.library, name)
        function.restype, function.argtypes = result, list(arguments)
        return function

    def extension(self, name: str, result: Any, *arguments: Any) -> Callable[..., Any]:
        """A function of an extension, or one of OpenGL."""
        address = self._address(name.encode())
        if not address:
            raise ProbeError(f"EGL has no function {name}")
        return ctypes.CFUNCTYPE(result, *arguments)(address)

    def lists_devices(self) -> bool:
        """Whether Magnum picks from a list of devices, rather than taking the default display."""
        listed = {"EGL_EXT_device_enumeration", "EGL_EXT_device_base"} & set(self.extensions)
        return bool(listed) and {"EGL_EXT_platform_base", "EGL_EXT_platform_device"} <= set(self.extensions)

    def refused(self, what: str) -> ProbeError:
        """Error that names EGL's own code."""
        return ProbeError(f"{what} failed with EGL error 0x{self.error():04X}")


def devices_of(egl: EGL) -> list[int]:
    """Handles of the devices, in EGL's order."""
    query = egl.extension("eglQueryDevicesEXT", ctypes.c_uint, _int, _pointer, _pointer)
    count = _int()
    if not query(0, None, ctypes.addressof(count)):
        raise egl.refused("eglQueryDevicesEXT")
    handles = (_pointer * max(count.value, 1))()
    if count.value and not query(count.value, ctypes.addressof(handles), ctypes.addressof(count)):
        raise egl.refused("eglQueryDevicesEXT")
    return [handles[index] for index in range(count.value)]


def describe(egl: EGL, device: int) -> dict[str, Any]:
    """Extensions, CUDA number and device file of one device."""
    string = egl.extension("eglQueryDeviceStringEXT", ctypes.c_char_p, _pointer, _int)
    egl.error()
    listed = string(device, _EXTENSIONS)
    # NVIDIA's 450 driver crashes when asked for the CUDA number of a GPU that this user may not open.
    if egl.error() == _BAD_DEVICE or listed is None:
        return {"extensions": [], "cuda": None, "file": None, "software": False, "accessible": False}
    extensions = listed.decode(errors="replace").split()
    file = string(device, _DRM_DEVICE_FILE) if "EGL_EXT_device_drm" in extensions else None
    return {
        "extensions": extensions,
        "cuda": _cuda_number(egl, device),
        "file": file.decode(errors="replace") if file else None,
        "software": "EGL_MESA_device_software" in extensions,
        "accessible": True,
    }


def _cuda_number(egl: EGL, device: int) -> int | None:
    attribute = egl.extension("eglQueryDeviceAttribEXT", ctypes.c_uint, _pointer, _int, _pointer)
    number = ctypes.c_ssize_t()
    return number.value if attribute(device, _CUDA_DEVICE, ctypes.addressof(number)) else None


def context_on(egl: EGL, device: int | None) -> dict[str, Any]:
    """Version and names of the OpenGL that a device gives.

    Args:
        egl: the library.
        device: its handle; None is the default display.
    """
    if device is None:
        display = egl.get_display(None)
    else:
        platform = egl.extension("eglGetPlatformDisplayEXT", _pointer, ctypes.c_uint, _pointer, _pointer)
        display = platform(_PLATFORM_DEVICE, device, None)
    if not display:
        raise egl.refused("eglGetPlatformDisplayEXT")
    if not egl.initialize(display, None, None):
        raise egl.refused("eglInitialize")
    try:
        _make_context(egl, display)
        return _described_context(egl, display)
    finally:
        egl.make_current(display, None, None, None)
        egl.terminate(display)


def _make_context(egl: EGL, display: int) -> None:
    if not egl.bind_api(_OPENGL_API):
        raise egl.refused("eglBindAPI(OpenGL)")
    wanted = (_int * 5)(_SURFACE_TYPE, _PBUFFER_BIT, _RENDERABLE_TYPE, _OPENGL_BIT, _NONE)
    config, count = _pointer(), _int()
    chosen = egl.choose_config(display, ctypes.addressof(wanted), ctypes.addressof(config), 1, ctypes.byref(count))
    if not chosen or not count.value:
        raise egl.refused("eglChooseConfig (OpenGL, pbuffer)")
    core = (_int * 5)(_CONTEXT_CLIENT_VERSION, 3, _CONTEXT_FLAGS, _FORWARD_COMPATIBLE, _NONE)
    compatible = (_int * 3)(_CONTEXT_FLAGS, 0, _NONE)
    for attributes in (core, compatible):
        if _current(egl, display, egl.create_context(display, config, None, ctypes.addressof(attributes))):
            # These two give a core context of just the version asked for, 3.0, and a compatible one of their newest.
            if attributes is core and _gl_strings(egl)[0] in ("NVIDIA Corporation", "ATI Technologies Inc."):
                continue
            return
    raise egl.refused("eglCreateContext (OpenGL)")


def _current(egl: EGL, display: int, context: int | None) -> bool:
    if context and not egl.make_current(display, None, None, context):
        raise egl.refused("eglMakeCurrent")
    return bool(context)


def _gl_strings(egl: EGL) -> list[str]:
    get = egl.extension("glGetString", ctypes.c_char_p, ctypes.c_uint)
    return [(get(name) or b"").decode(errors="replace") for name in (_GL_VENDOR, _GL_RENDERER, _GL_VERSION)]


def _described_context(egl: EGL, display: int) -> dict[str, Any]:
    names = _gl_strings(egl)
    number = re.match(r"(\d+)\.(\d+)", names[2])
    return {
        "egl_vendor": (egl.query_string(display, _VENDOR) or b"").decode(errors="replace"),
        "vendor": names[0],
        "renderer": names[1],
        "version": names[2],
        "number": [int(part) for part in number.groups()] if number else [0, 0],
    }


def probe(index: int | None) -> dict[str, Any]:
    """The answer as a JSON value: `loads`, `error`, `devices` and, when an index is given, `context`."""
    answer: dict[str, Any] = {"loads": False, "error": None, "lists_devices": False, "devices": [], "context": None}
    try:
        egl = EGL()
    except OSError as error:
        return answer | {"error": str(error)}
    answer |= {"loads": True, "lists_devices": egl.lists_devices()}
    try:
        handles = devices_of(egl) if answer["lists_devices"] else []
        answer["devices"] = [describe(egl, handle) for handle in handles]
        if index is not None:
            if answer["lists_devices"] and index >= len(handles):
                raise ProbeError(f"there is no EGL device {index}, only {len(handles)}")
            answer["context"] = context_on(egl, handles[index] if handles else None)
    except ProbeError as error:
        answer["error"] = str(error)
    return answer


if __name__ == "__main__":
    print(json.dumps(probe(int(sys.argv[1]) if len(sys.argv) > 1 else None)))
