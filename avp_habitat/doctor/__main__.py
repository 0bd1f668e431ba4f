"""Command line of the doctor: all checks side by side, one line each in a fixed order."""

import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from avp_habitat import command, doctor
from avp_habitat.doctor import ABSENT, BROKEN, OK, Finding, ask
from avp_habitat.errors import AVPError, SimulatorError
from avp_habitat.provenance import version_of
from avp_habitat.simulators.habitat.graphics import FIRST_DEVICE, choose_gpu, inspect_graphics
from avp_habitat.simulators.habitat.installed import inspect_installation

LPIPS_WEIGHTS = "alexnet-owt-7be5be79.pth"
# One of the suite's kernels stands for all.
_COMPILED = "import json; from avp_habitat.task.floor_map import draw as f; print(json.dumps(f.stats.cache_path))"
_TORCH = (
    "import json, torch; there = torch.cuda.is_available(); "
    "print(json.dumps([torch.__version__, torch.version.cuda, torch.cuda.get_device_name() if there else None]))"
)
Check = Callable[[], list[Finding]]


def check_simulator(name: str) -> list[Finding]:
    """Whether a simulator opens the built-in room and renders, or why not."""
    subject = f"simulator {name}"
    found, failure = ask(doctor.probe(doctor.open_room, name), time_limit_s=120.0)
    if failure is not None:
        more = f"python -c 'from avp_habitat.doctor import open_room; print(open_room(\"{name}\"))'"
        return [Finding(BROKEN, subject, f"{failure}; the whole message: {more}")]
    absent = name == "habitat" and not inspect_installation().installed
    return [Finding(ABSENT if absent else found["mark"], subject, found["text"])]


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
    subject, (place, failure) = "compiled code", ask(["-c", _COMPILED], time_limit_s=60.0)
    if failure is not None:
        return [Finding(BROKEN, subject, f"{failure}; pip install --force-reinstall numba")]
    if place is None:
        text = "cannot be kept, so that each program compiles for half a minute; name a folder in NUMBA_CACHE_DIR"
        return [Finding(ABSENT, subject, text)]
    return [Finding(OK, subject, f"kept in {place}; NUMBA_CACHE_DIR names another folder")]


def check_cuda() -> list[Finding]:
    """PyTorch's CUDA, which nerfstudio wants; the suite and PPO run without."""
    subject = "CUDA for torch"
    if version_of("torch") is None:
        return [Finding(ABSENT, subject, "torch is not installed; pip install 'avp-suite[nerfstudio]'")]
    found, failure = ask(["-c", _TORCH], time_limit_s=60.0)
    if failure is not None:
        text = f"import torch: {failure}; install torch and torchvision together from the package index"
        return [Finding(BROKEN, subject, text)]
    version, built, device = found
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


def all_checks() -> dict[str, Check]:
    """The checks by name, in the order of the report."""
    plugs = doctor.read_manifest()
    hosts = dict.fromkeys(plug.host for plug in plugs)
    return {
        "Python": doctor.check_python,
        "packages": doctor.check_packages,
        "numba": check_compiled,
        "raycast": partial(check_simulator, "raycast"),
        "habitat": partial(check_simulator, "habitat"),
        "graphics": check_graphics,
        "torch": check_cuda,
        "LPIPS": check_lpips,
        **{host: partial(doctor.check_host, host, [plug for plug in plugs if plug.host == host]) for host in hosts},
    }


@dataclass(frozen=True)
class Doctor:
    """What is installed, what can run here and what the hosts see: ok, -- (not here, optional), !! (broken).

    Exit code 1 when anything is broken.
    """

    json: bool = False
    """Print one JSON object instead of lines."""


def main(options: Doctor) -> None:
    """Run every check side by side and print what was found in order; an error when something is broken."""
    found: list[Finding] = []
    with ThreadPoolExecutor(max_workers=max(3, os.cpu_count() or 1)) as pool:
        for name, future in {name: pool.submit(check) for name, check in all_checks().items()}.items():
            if sys.stderr.isatty() and not future.done():
                print(f"looking at {name} ...\033[K", end="\r", file=sys.stderr, flush=True)
            found += future.result()
            if not options.json:
                for finding in future.result():
                    print(finding.line(colour=sys.stdout.isatty()), flush=True)
    broken = [finding.subject for finding in found if finding.mark == BROKEN]
    if options.json:
        print(json.dumps({"ok": not broken, "findings": [finding._asdict() for finding in found]}, indent=2))
    if broken:
        raise AVPError(f"broken: {', '.join(broken)}; what to do stands in the lines marked {BROKEN}")


if __name__ == "__main__":
    sys.exit(command.run(main))
