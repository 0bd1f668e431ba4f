"""Runs a program that must not outlive the process that wanted it: `python -m avp_sb3.rerun.guard PROGRAM ARGUMENT …`.

The standard input is the leash: it ends when the other process closes it or dies, even by SIGKILL.
"""

import os
import subprocess
import sys
import threading
from collections.abc import Sequence


def main(arguments: Sequence[str]) -> int:
    """Run the program until it ends or the standard input does; its exit code."""
    child = subprocess.Popen(arguments, stdin=subprocess.DEVNULL)

    def wait_for_the_end_of_the_leash() -> None:
        # Without a buffer, whose lock Python would want when the program ends first and this still waits.
        while os.read(sys.stdin.fileno(), 1024):
            pass
        child.kill()

    threading.Thread(target=wait_for_the_end_of_the_leash, daemon=True).start()
    return child.wait()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
