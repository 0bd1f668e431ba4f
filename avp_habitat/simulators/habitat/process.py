"""One simulator per process, and none in a process that was forked from one that had a simulator.

Habitat-Sim's graphics context is one per process and belongs to the thread that made it; a forked child inherits the
parent's without the driver's threads and locks behind it. Seen with habitat-sim 0.3.4 on Mesa 22.3.6: rendering in a
forked child never returns, opening a simulator there is a SIGABRT, and so is rendering in another thread.
"""

import importlib
import importlib.util
import os
import sys
import threading

from avp_habitat.errors import SimulatorError

_TRITON = "triton._C.libtriton"
_ONE_EACH = 'give each environment a process of its own: SubprocVecEnv(start_method="forkserver")'


class _State:
    """What this process, or the one it was forked from, has done."""

    opener: int | None = None
    """Process id of the first that opened a simulator; a forked child inherits it."""
    scene: str | None = None
    """Scene of the open simulator."""
    thread: int | None = None
    """Thread in which it was opened: the graphics context belongs to that one."""
    triton_is_safe: bool = False
    """Whether triton was loaded here, in the way that does not collide."""


def claim(scene: str) -> None:
    """Take this process's one place for a simulator; call it before anything of Habitat-Sim is opened.

    Args:
        scene: as the user named it; the error of a second `claim` shows both.

    Raises:
        SimulatorError: this process has an open simulator, or was forked from one that ever opened any.
    """
    check_not_forked(scene)
    if _State.scene is not None:
        raise SimulatorError(
            f"habitat: this process already has a simulator, on {_State.scene}, so {scene} cannot be opened: "
            f"Habitat-Sim allows one per process; close the first, or {_ONE_EACH}"
        )
    _State.opener, _State.scene, _State.thread = os.getpid(), scene, threading.get_ident()


def release() -> bool:
    """Give the place back after a simulator was closed, or could not be opened.

    Returns:
        Whether the place was this process's. False tells a forked child not to close what its parent still uses.
    """
    if _State.opener != os.getpid() or _State.scene is None:
        return False
    _State.scene = _State.thread = None
    return True


def check_process(scene: str) -> None:
    """Check that the simulator of a scene may be used here; costs about a microsecond.

    Args:
        scene: of the simulator, for the error's text.

    Raises:
        SimulatorError: this process was forked from the one that opened it, or this is another thread.
    """
    check_not_forked(scene)
    if _State.thread is not None and _State.thread != threading.get_ident():
        raise SimulatorError(
            f"habitat: the simulator of {scene} was opened in another thread, and Habitat-Sim's graphics belong to "
            f"that one; use it from there, or {_ONE_EACH}"
        )


def check_not_forked(scene: str) -> None:
    """Check that no simulator was open when this process was forked; see `check_process`."""
    if _State.opener is not None and _State.opener != os.getpid():
        raise SimulatorError(
            f"habitat: {scene} cannot be used here: this process was forked from process {_State.opener} after that "
            f"one had opened a simulator, and a fork cannot use the graphics it inherits; start workers before the "
            f"first simulator, or {_ONE_EACH}"
        )


def import_before_graphics() -> None:
    """Load triton, where it is installed, while that is still possible; call it before `import magnum`.

    Triton (which torch brings along and `torch._dynamo` imports) and Mesa each carry an LLVM. Measured with habitat-sim
    0.3.4, triton 3.9.0, torch 2.15.0 and Mesa 22.3.6 (LLVM 15, llvmpipe):

        simulator, then triton or torch._dynamo     SIGSEGV
        magnum or habitat_sim, triton, simulator    SIGABRT "LLVM ERROR": importing corrade switches Python to
                                                    RTLD_GLOBAL, so that Mesa finds triton's LLVM; not so when
                                                    the flag is off while triton is loaded
        triton, then the simulator                  runs, and `torch._dynamo` can be imported later
        torch or numba, on either side              runs

    So triton's extension is enough: 0.2 s, and torch itself (2 to 5 s) is left alone.

    Raises:
        SimulatorError: triton was loaded after magnum already, so that a simulator would end the process.
    """
    if _State.triton_is_safe:
        return
    if _TRITON in sys.modules:
        names = list(sys.modules)
        if "corrade" in names and names.index("corrade") < names.index(_TRITON):
            raise SimulatorError(
                "habitat: triton (part of torch) was imported after habitat_sim, and then the graphics driver ends the "
                "process; import torch._dynamo, or avp_habitat's simulator, before habitat_sim"
            )
        return
    if importlib.util.find_spec("triton") is not None:
        _import_triton()


def _import_triton() -> None:
    flags = sys.getdlopenflags()
    sys.setdlopenflags(flags & ~os.RTLD_GLOBAL)
    try:
        importlib.import_module(_TRITON)
        _State.triton_is_safe = True
    except ImportError:
        # A triton that cannot be loaded cannot collide with anything.
        return
    finally:
        sys.setdlopenflags(flags)
