"""MLflow's own page in a real browser: a server on loopback, and a browser that asks nobody else."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

CHROMIUM = Path("/usr/bin/chromium")
_FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
_START_S = 240.0
_END_S = 20.0
_PAGE_MS = 120_000
# MLflow opens its assistant beside the first page that a browser ever sees, and shows hints over others.
_SEEN_BEFORE = """
for (const name of ["assistant.fab.autoOpenedOnFirstLoad", "detectIssues.guidanceShown"]) {
    localStorage.setItem(`mlflow.${name}_v1`, "true");
}
"""


@contextmanager
def mlflow_server(store: str, folder: Path) -> Iterator[str]:
    """A stock `mlflow server` while the block runs.

    Args:
        store: address of the runs, for example `sqlite:////…/mlflow.db`.
        folder: for its log and for artifacts of experiments that it makes.

    Yields:
        Its address, on a free port of loopback.
    """
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    folder.mkdir(parents=True, exist_ok=True)
    words = ["--backend-store-uri", store, "--default-artifact-root", str(folder / "artifacts")]
    words += ["--host", "127.0.0.1", "--port", str(port), "--workers", "1"]
    quiet = {"MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "1", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"}
    environment = {key: value for key, value in os.environ.items() if key != "MLFLOW_TRACKING_URI"} | quiet
    with (folder / "server.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "mlflow", "server", *words],
            env=environment,
            cwd=folder,
            stdout=log,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # It starts workers, which have to end with it.
        )
    try:
        address = f"http://127.0.0.1:{port}"
        _wait(address, process, folder / "server.log")
        yield address
    finally:
        _end(process)


@contextmanager
def chromium() -> "Iterator[Browser]":
    """Debian's Chromium without a window, while the block runs."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(_FLAGS))
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(browser: "Browser", address: str, path: str, *, size: tuple[int, int] = (1400, 900)) -> "Iterator[Page]":
    """A page as somebody sees it who has never been there, while the block runs.

    Args:
        browser: to open it with; it keeps nothing from one page to the next.
        address: of the server; requests to others are refused.
        path: what follows the address.
        size: of the window in pixels.
    """

    def only_here(route: "Route") -> None:
        if route.request.url.startswith((address, "data:", "blob:")):
            route.continue_()
        else:
            route.abort()

    context = browser.new_context(viewport={"width": size[0], "height": size[1]})
    try:
        context.set_default_timeout(_PAGE_MS)
        context.add_init_script(_SEEN_BEFORE)
        context.route("**/*", only_here)
        page = context.new_page()
        page.goto(f"{address}/{path}")
        yield page
    finally:
        context.close()


def _wait(address: str, process: subprocess.Popen, log: Path) -> None:
    until = time.monotonic() + _START_S
    # Directly, whatever proxy is configured.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    while time.monotonic() < until and process.poll() is None:
        with suppress(OSError), opener.open(f"{address}/health", timeout=5):
            return
        time.sleep(0.2)
    raise RuntimeError(f"mlflow server did not answer at {address}: {log.read_text(errors='replace')[-2000:]}")


def _end(process: subprocess.Popen) -> None:
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_END_S)
            break
    with suppress(ProcessLookupError):  # Workers that outlived it.
        os.killpg(process.pid, signal.SIGKILL)
