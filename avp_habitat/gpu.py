"""Whether this machine has a CUDA device, told without importing torch, and what nerfstudio's commands need if not."""

import ctypes
from importlib import metadata

WITHOUT_GPU = "--machine.device-type cpu --pipeline.model.implementation torch --mixed-precision False"
"""Options with which nerfstudio's own methods run on a CPU; `avp-nerfacto` chooses by itself."""


def has_cuda() -> bool:
    """Whether torch, as it is installed, would find a CUDA device: asks NVIDIA's driver, in milliseconds."""
    try:
        if metadata.version("torch").endswith("+cpu"):
            return False
    except metadata.PackageNotFoundError:
        pass
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        count = ctypes.c_int(0)
        return driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0
    except (OSError, AttributeError):
        return False


def nerfacto_line(data: str) -> str:
    """The command line that trains plain nerfacto on a rollout on this machine.

    Args:
        data: the rollout's folder, quoted for a shell.
    """
    options = "" if has_cuda() else f"{WITHOUT_GPU} "
    return f"ns-train nerfacto {options}avp-data --data {data}"
