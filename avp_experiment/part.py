"""`python -m avp_experiment.part COMMAND …`: a command of the suite, once this Python is known to have its packages."""

import runpy
import sys
from pathlib import Path

if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit("usage: python -m avp_experiment.part MODULE_OR_SCRIPT [its options]")
    del sys.argv[0]
    name = sys.argv[0]
    if Path(name).suffix == ".py":
        # As `python SCRIPT` does, so that it finds what lies beside it.
        sys.path.insert(0, str(Path(name).parent))
        runpy.run_path(name, run_name="__main__")
    else:
        runpy.run_module(name, run_name="__main__", alter_sys=True)
