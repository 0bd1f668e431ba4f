"""What command lines say of an MLflow run: which one it is, how to look at it, what is still to be sent."""

import shlex
from urllib.parse import urlsplit

from avp_habitat.tracking.addresses import shown

DELIVER = "python -m avp_habitat.tracking.deliver"


def how_to_look(address: str) -> str:
    """The server's page, or the command that opens one.

    Args:
        address: of the store; its password is not repeated.
    """
    if urlsplit(address).scheme in ("http", "https"):
        return shown(address)
    return f"mlflow ui --backend-store-uri {shlex.quote(shown(address))}"


def about_run(run_id: str, address: str, *, delivered: bool = True) -> str:
    """Two lines on a run.

    Args:
        run_id: MLflow's, or one given offline.
        address: of its store.
        delivered: whether MLflow has all of it.
    """
    lines = [f"MLflow:   run {run_id}"]
    if not delivered:
        lines.append(f"send:     {DELIVER}  (MLflow does not have all of the run yet)")
    else:
        lines.append(f"compare:  {how_to_look(address)}")
    return "\n".join(lines)
