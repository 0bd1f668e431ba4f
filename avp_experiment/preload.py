"""What the process from which cells are forked imports: everything heavy that their commands use."""

import contextlib
import importlib
import warnings

MODULES = ("avp_sb3", "avp_nerfstudio.method.reconstruction", "avp_habitat.collect", "avp_experiment.execute")
"""An extra that is not installed is missed by the commands that need it, in words of theirs."""

# Hosts warn about each other's versions, on which nobody can act here.
warnings.simplefilter("ignore")
for module in MODULES:
    with contextlib.suppress(ImportError):
        importlib.import_module(module)
