"""`python -m avp_nerfstudio.reconstruct`: train on one rollout and score its held-out views, in one process.

Importing nerfstudio takes seconds; a program with many reconstructions pays for it once by calling `reconstruct`, or
`main`, in forks of a process that has imported `avp_nerfstudio.method.preload`.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from avp_habitat import command
from avp_habitat.errors import RolloutError, UsageError, unknown_name
from avp_habitat.files import NewFolder
from avp_habitat.metrics import explained
from avp_habitat.rollout.format import Rollout, read_rollout
from avp_habitat.tracking.stores import DEFAULT_ADDRESS, address_of, open_store

METHODS = ("avp-nerfacto", "nerfacto")
SEED = 42
"""nerfstudio's own."""


@dataclass(frozen=True)
class Request:
    """What to reconstruct, and how."""

    rollout: Path
    """Its folder."""
    out: Path
    """The folder to write; must not exist."""
    method: str = METHODS[0]
    """One of `METHODS`."""
    frames: int | None = None
    """Train on the first so many captured frames; None for all."""
    iterations: int | None = None
    """Of the training; None for the method's own number."""
    seed: int = SEED
    """Of nerfstudio's random numbers."""
    keep_checkpoint: bool = False
    """Keep what nerfstudio's commands need to open the training again."""
    pictures: tuple[int, ...] = ()
    """Held-out views to keep as pictures, from 0."""
    mlflow: str | None = None
    """MLflow address, None for none."""


def reconstruct(request: Request) -> dict[str, Any]:
    """Train on a rollout, score all held-out views, write the folder.

    Returns:
        What `scores.json` holds.

    Raises:
        UsageError: an option cannot be right, or the folder exists.
        RolloutError: the rollout cannot be used.
        AVPError: the folder cannot be written, or MLflow cannot be reached; nothing is left behind.
    """
    started = time.monotonic()
    _check_options(request)
    with NewFolder(request.out) as folder:
        rollout = read_rollout(request.rollout)
        _check_rollout(request, rollout)
        if request.mlflow:
            open_store(request.mlflow)  # before anything is trained, which takes long
        with warnings.catch_warnings():
            # nerfstudio and what it imports warn their developers, at length.
            warnings.simplefilter("ignore")
            from avp_nerfstudio.method.reconstruction import process

            found = process(request, rollout, folder, started=started)
        folder.publish()
    return found


def _check_options(request: Request) -> None:
    if request.method not in METHODS:
        raise unknown_name("method", request.method, METHODS)
    if request.iterations is not None and request.iterations < 1:
        raise UsageError(f"--iterations: expected a number from 1, got {request.iterations}")
    if not 0 <= request.seed < 2**32:
        raise UsageError(f"--seed: expected a whole number from 0 to 2^32 - 1, got {request.seed}")


def _check_rollout(request: Request, rollout: Rollout) -> None:
    for kind, views in (("captured frame", rollout.frames), ("held-out view", rollout.heldout)):
        if not views:
            raise RolloutError(f"{rollout.folder}: expected at least one {kind}, found none")
    count = len(rollout.frames)
    if request.frames is not None and not 1 <= request.frames <= count:
        raise UsageError(
            f"--frames: expected 1 to {count}, the captured frames of {rollout.folder}, got {request.frames}"
        )
    last = len(rollout.heldout) - 1
    for index in request.pictures:
        if not 0 <= index <= last:
            raise UsageError(f"--pictures: expected 0 to {last}, the held-out views of {rollout.folder}, got {index}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m avp_nerfstudio.reconstruct",
        epilog=explained("PSNR", "SSIM", "LPIPS"),
        description="Train on the captured frames of a rollout, score its held-out views, and write the scores to a "
        "folder that exists only when all is done.",
    )
    add = parser.add_argument
    add("rollout", type=Path, metavar="ROLLOUT", help="the rollout's folder")
    add("--out", required=True, type=Path, metavar="FOLDER", help="the folder to write; must not exist")
    add("--method", default=METHODS[0], help=f"{' or '.join(METHODS)} (default: %(default)s)")
    add("--frames", type=int, metavar="K", help="train on the first K captured frames (default: all)")
    add("--iterations", type=int, metavar="N", help="of the training (default: the method's own number)")
    add("--seed", type=int, default=SEED, help="of the training (default: %(default)s)")
    add(
        "--keep-checkpoint",
        action="store_true",
        help="keep config.yml and checkpoint, for ns-eval, ns-render, ns-viewer and ns-export",
    )
    add("--pictures", type=int, nargs="+", default=[], metavar="I", help="held-out views to keep as PNG, from 0")
    add(
        "--mlflow",
        default="off",
        metavar="ADDRESS",
        help=f"log settings and scores as an MLflow run at an address such as {DEFAULT_ADDRESS}; auto: "
        "MLFLOW_TRACKING_URI if that is set, else nowhere; off: nowhere (default: %(default)s)",
    )
    return parser


def _request(argv: Sequence[str]) -> Request:
    options = _parser().parse_args(argv)
    return Request(
        rollout=options.rollout,
        out=options.out,
        method=options.method,
        frames=options.frames,
        iterations=options.iterations,
        seed=options.seed,
        keep_checkpoint=options.keep_checkpoint,
        pictures=tuple(options.pictures),
        mlflow=address_of(options.mlflow, default=None),
    )


def main(argv: Sequence[str]) -> None:
    """Reconstruct one rollout; print its scores."""
    request = _request(argv)
    found = reconstruct(request)
    words = ", ".join(f"{name} {value:.4g}" for name, value in found["scores"].items() if value is not None)
    missing = "" if found["lpips_reason"] is None else ", no lpips (scores.json says why)"
    print(f"{request.out}: {words}{missing}")


if __name__ == "__main__":
    sys.exit(command.run(main))
