"""Whether the simulators, compiled code, the graphics device and PyTorch's CUDA run here; each is really tried."""

import os
from pathlib import Path

from avp_habitat.doctor.asking import ask
from avp_habitat.doctor.finding import ABSENT, BROKEN, OK, Finding
from avp_habitat.errors import SimulatorError
from avp_habitat.provenance import version_of
from avp_habitat.simulators.habitat.graphics import FIRST_DEVICE, choose_gpu, inspect_graphics
from avp_habitat.simulators.habitat.installed import inspect_installation, require_installed

LPIPS_WEIGHTS = "alexnet-owt-7be5be79.pth"
_OPEN_LIMIT_S = 120.0
_TORCH_LIMIT_S = 60.0
_COMPILED_LIMIT_S = 60.0
# One of the suite's kernels stands for all.
_COMPILED = "import json; from avp_habitat.task.floor_map import draw as f; print(json.dumps(f.stats.cache_path))"
_TORCH = (
    "import json, torch; there = torch.cuda.is_available(); "
    "print(json.dumps([torch.__version__, torch.version.cuda, torch.cuda.get_device_name() if there else None]))"
)


def check_raycast() -> list[Finding]:
    """The embedded simulator opens the built-in room and renders."""
    return [_opened("raycast")]


def check_habitat() -> list[Finding]:
    """Habitat-Sim does so too, or why not."""
    try:
        require_installed()
    except SimulatorError as error:
        mark = BROKEN if inspect_installation().installed else ABSENT
        return [Finding(mark, "simulator habitat", str(error))]
    return [_opened("habitat")]


def _opened(name: str) -> Finding:
    subject = f"simulator {name}"
    answer = ask(["-m", "avp_habitat.doctor.open_simulator", name], time_limit_s=_OPEN_LIMIT_S)
    if answer.failure is not None:
        again = f"python -m avp_habitat.doctor.open_simulator {name}"
        return Finding(BROKEN, subject, f"{answer.failure}; the whole message: {again}")
    if "error" in answer.value:
        return Finding(BROKEN, subject, answer.value["error"])
    return Finding(
        OK, subject, f"{answer.value['version']}: opened builtin:0 and rendered in {answer.value['seconds']:.1f} s"
    )


def check_graphics() -> list[Finding]:
    """The device that `--gpu` takes by itself. Only Habitat-Sim needs one."""
    try:
        gpu = choose_gpu(None)
    except SimulatorError as error:
        needed = inspect_installation().installed
        text = str(error).removeprefix("habitat: ")
        return [Finding(BROKEN if needed else ABSENT, "graphics (EGL)", text if needed else f"{text} (habitat only)")]
    state = inspect_graphics(inspect_graphics().index_of(gpu))
    renderer = state.context.renderer if state.context else "unknown"
    others = [str(number) for number in state.cuda_numbers if number != gpu]
    also = f"; also --gpu {', '.join(others)}" if others else ""
    kind = "EGL's first device" if gpu == FIRST_DEVICE else f"CUDA device {gpu}"
    return [Finding(OK, "graphics (EGL)", f"--gpu takes {gpu}: {kind}, {renderer}{also}")]


def check_compiled() -> list[Finding]:
    """Where Numba keeps the suite's compiled kernels; without any place each program compiles them again."""
    subject = "compiled code"
    answer = ask(["-c", _COMPILED], time_limit_s=_COMPILED_LIMIT_S)
    if answer.failure is not None:
        return [Finding(BROKEN, subject, f"{answer.failure}; pip install --force-reinstall numba")]
    if answer.value is None:
        text = "cannot be kept, so that each program compiles for half a minute; name a folder in NUMBA_CACHE_DIR"
        return [Finding(ABSENT, subject, text)]
    return [Finding(OK, subject, f"kept in {answer.value}; NUMBA_CACHE_DIR names another folder")]


def check_cuda() -> list[Finding]:
    """PyTorch's CUDA, which nerfstudio wants; the suite and PPO run without."""
    subject = "CUDA for torch"
    if version_of("torch") is None:
        return [Finding(ABSENT, subject, "torch is not installed; pip install 'avp-suite[nerfstudio]'")]
    answer = ask(["-c", _TORCH], time_limit_s=_TORCH_LIMIT_S)
    if answer.failure is not None:
        text = f"import torch: {answer.failure}; install torch and torchvision together from the package index"
        return [Finding(BROKEN, subject, text)]
    version, built, device = answer.value
    if device is not None:
        return [Finding(OK, subject, f"torch {version} on {device}")]
    why = f"built for CUDA {built}, but finds no device" if built else "built without CUDA"
    text = f"torch {version} is {why}; ns-train runs on the CPU: --machine.device-type cpu"
    return [Finding(ABSENT, subject, text)]


def check_lpips() -> list[Finding]:
    """AlexNet's weights, without which a reconstruction's LPIPS needs the network."""
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    home = Path(os.path.expanduser(os.environ.get("TORCH_HOME") or f"{cache}/torch"))
    path = home / "hub" / "checkpoints" / LPIPS_WEIGHTS
    if path.is_file():
        return [Finding(OK, "LPIPS weights", str(path))]
    text = f"not in {path.parent}: downloaded when first needed; without network put {LPIPS_WEIGHTS} there, or set "
    return [Finding(ABSENT, "LPIPS weights", f"{text}TORCH_HOME to a folder that holds it in hub/checkpoints")]
