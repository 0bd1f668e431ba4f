"""`python -m avp_habitat.tracking.deliver`: send MLflow what it could not be sent while a program ran."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from avp_habitat import command
from avp_habitat.errors import UsageError
from avp_habitat.tracking.journal import SPOOL_VARIABLE, Journal, spool_folder
from avp_habitat.tracking.opening import Recovered, finish, left_journals
from avp_habitat.tracking.stores import TrackingError, absolute, shown

# Somebody waits for this, and a server that has just been started takes long over its first answers.
_PATIENCE_S = 120.0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_habitat.tracking.deliver",
        description="Send MLflow the points and files of runs that it could not be sent while they lasted; close runs "
        "whose program was killed. Each point arrives once, however often this is run.",
    )
    add = parser.add_argument
    add(
        "--spool", type=Path, metavar="DIR", help=f"where they wait (default: {SPOOL_VARIABLE}, else runs/mlflow-spool)"
    )
    add("--mlflow", metavar="ADDRESS", help="send them there instead of where they were meant for")
    add("--again", action="store_true", help="try also what MLflow refused")
    add("--list", action="store_true", help="only say what waits")
    return parser


def main(argv: Sequence[str]) -> None:
    """Deliver; an error when something stays."""
    options = _parser().parse_args(argv)
    spool = (options.spool or spool_folder()).absolute()
    if options.spool is not None and not spool.is_dir():
        raise UsageError(f"--spool {options.spool}: no such folder")
    journals = {folder: header for folder in sorted(spool.glob("*")) if (header := Journal.peek(folder)) is not None}
    if not journals:
        print(f"{spool}: nothing waits")
        return
    if options.list:
        for folder, header in journals.items():
            print(f"{folder.name}  run {header['run_id'] or '(none yet)'}  for {shown(header['address'])}")
        return
    done = _deliver(spool, len(journals), address=options.mlflow, again=options.again)
    for result in done:
        print(_line(result))
    if busy := len(journals) - len(done):
        print(f"{busy} of {len(journals)} belong to programs that still run")
    if failed := sum(not result.delivered for result in done):
        raise TrackingError(f"{failed} of {len(journals)} runs could not be sent; they stay in {spool}")


def _deliver(spool: Path, count: int, *, address: str | None, again: bool) -> list[Recovered]:
    done = []
    with tqdm(total=count, unit="run", desc="sending", disable=None) as progress:
        for journal in left_journals(spool):
            if address is not None:
                journal.header["address"] = absolute(address)
            done.append(finish(journal, again=again, timeout_s=_PATIENCE_S))
            progress.update()
    return done


def _line(result: Recovered) -> str:
    what = "sent" if result.delivered else "NOT sent"
    killed = ", its program was killed" if result.killed else ""
    return f"run {result.run_id} at {shown(result.address)}: {what} ({result.status}{killed})"


if __name__ == "__main__":
    sys.exit(command.run(main))
