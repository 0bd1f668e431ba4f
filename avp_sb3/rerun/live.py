"""Recordings shown while they grow: in a window, in a browser, or in a viewer that is open somewhere."""

import atexit
import importlib.util
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import IO
from urllib.parse import quote, urlsplit

import rerun as rr
import rerun.blueprint as rrb

from avp_habitat.errors import AVPError, UsageError
from avp_sb3.rerun.layout import APPLICATION

_PART = 1 << 16
_SETTINGS_FRAME, _FRAME_TYPE_AT = 4, 3


class Relay:
    """Forwards one connection from a free port of 127.0.0.1 to a viewer.

    Rerun's own connection, when the viewer does not read (a suspended machine, a stopped process), first fills 200 MB
    of memory, then blocks whoever logs, and keeps the process from ending. Cutting the relay ends all of that.
    """

    def __init__(self, host: str, port: int, *, timeout_s: float, patience_s: float) -> None:
        """Connect.

        Args:
            host: of the viewer.
            port: of the viewer.
            timeout_s: for connecting, seconds.
            patience_s: a viewer that takes nothing for so many seconds is lost.

        Raises:
            OSError: nothing listens there.
        """
        self._far = socket.create_connection((host, port), timeout=timeout_s)
        self._far.settimeout(None)
        self._patience_s = patience_s
        self._blocked_since: float | None = None
        self._cut = False
        self._answered = threading.Event()
        self._greeting = b""
        self._near: socket.socket | None = None
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._serve, name="rerun relay", daemon=True).start()

    @property
    def lost(self) -> bool:
        """Whether the viewer has gone, or takes nothing any more."""
        since = self._blocked_since
        return self._cut or (since is not None and time.monotonic() - since > self._patience_s)

    def speaks_http2(self, timeout_s: float) -> bool:
        """Whether the other side answers as every gRPC server does: with a SETTINGS frame first (RFC 9113, 3.4).

        Args:
            timeout_s: how long to wait for its first bytes, seconds.

        Returns:
            False also for a side that says nothing in that time, or ends the connection.
        """
        self._answered.wait(timeout_s)
        return self._greeting[_FRAME_TYPE_AT:] == bytes([_SETTINGS_FRAME])

    def cut(self) -> None:
        """End both connections at once."""
        self._cut = True
        self._answered.set()
        for connection in (self._listener, self._near, self._far):
            if connection is not None:
                with suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
                connection.close()

    def _serve(self) -> None:
        with suppress(OSError):
            self._near, _ = self._listener.accept()
            self._listener.close()
            threading.Thread(target=self._forward, args=(self._far, self._near), daemon=True).start()
            self._forward(self._near, self._far)

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while part := source.recv(_PART):
                if target is self._far:
                    self._blocked_since = time.monotonic()
                elif not self._answered.is_set():
                    self._greet(part)
                target.sendall(part)
                if target is self._far:
                    self._blocked_since = None
        self.cut()

    def _greet(self, part: bytes) -> None:
        self._greeting = (self._greeting + part)[: _FRAME_TYPE_AT + 1]
        if len(self._greeting) > _FRAME_TYPE_AT:
            self._answered.set()


VIEWER, WEB = "viewer", "web"
_LOOPBACK, _PORT, _WEB_PORT = "127.0.0.1", 9876, 9090
_MEMORY = "1GiB"
_START_S, _CONNECT_S, _ANSWER_S, _PATIENCE_S, _STAYS_S = 30.0, 5.0, 15.0, 5.0, 0.5


class LiveError(AVPError):
    """A viewer that cannot be started or reached."""


class LiveViewer:
    """Where recordings are shown live; a viewer that goes away or stops reading is left alone, said once.

    Rerun's own servers listen on all of the machine's addresses. Here its program runs as a child process that listens
    on 127.0.0.1 only, keeps at most 1 GiB of the newest data, and ends with `close()` or with this process.
    """

    def __init__(self, target: str) -> None:
        """Choose the viewer; nothing is started yet.

        Args:
            target: `viewer`, `web`, or the address of an open viewer, `rerun+http://HOST:PORT/proxy`.

        Raises:
            UsageError: neither of them.
        """
        self._target = target
        self._address = None if target in (VIEWER, WEB) else _host_and_port(target)
        self._child: subprocess.Popen[bytes] | None = None
        self._relay: Relay | None = None
        self._recording: rr.RecordingStream | None = None
        self.url: str | None = None
        """The page of a web viewer, once it is served."""

    @property
    def recording(self) -> rr.RecordingStream | None:
        """Where to log to; None when nobody is looking (any more)."""
        if self._relay is not None and self._relay.lost and self._recording is not None:
            print(f"RerunCallback: lost the live viewer ({self._target}); the training goes on", file=sys.stderr)
            self.finish()
        return self._recording

    def open(self, recording_id: str, blueprint: rrb.Blueprint) -> None:
        """Begin a recording, in a viewer that is started if need be.

        Args:
            recording_id: that of the file.
            blueprint: how the viewer lays it out.

        Raises:
            LiveError: the viewer cannot be started or reached.
        """
        self.finish()
        if self._target in (VIEWER, WEB) and (self._child is None or self._child.poll() is not None):
            self._start()
        assert self._address is not None
        try:
            self._relay = Relay(*self._address, timeout_s=_CONNECT_S, patience_s=_PATIENCE_S)
        except OSError as error:
            raise LiveError(f"{self._target}: no Rerun viewer there ({error}); start one with `rerun`") from None
        self._recording = rr.RecordingStream(APPLICATION, recording_id=recording_id)
        try:
            self._recording.connect_grpc(
                f"rerun+http://{_LOOPBACK}:{self._relay.port}/proxy", default_blueprint=blueprint
            )
            # A flush returns as soon as its bytes are sent, also to somebody who does not understand them.
            self._recording.flush(timeout_sec=_ANSWER_S)
            if not self._relay.speaks_http2(_ANSWER_S):
                raise RuntimeError("it ended the connection" if self._relay.lost else "it does not answer with HTTP/2")
        except (RuntimeError, ValueError) as error:
            self.finish()
            raise LiveError(f"{self._target}: what listens there is no Rerun viewer ({error})") from None

    def finish(self) -> None:
        """End the recording; what it holds stays in the viewer."""
        if self._recording is None or self._relay is None:
            return
        ending = threading.Thread(target=self._recording.disconnect, name="rerun end", daemon=True)
        self._recording = None
        ending.start()
        if not self._relay.lost:
            ending.join(_PATIENCE_S)
        self._relay.cut()
        ending.join(_PATIENCE_S)
        self._relay = None

    def close(self) -> None:
        """End the recording, and the viewer or server if it was started here."""
        self.finish()
        if self._child is None:
            return
        atexit.unregister(self.close)
        assert self._child.stdin is not None
        self._child.stdin.close()
        self._child.wait()
        self._child = None

    def _start(self) -> None:
        port, web_port = _free_port(_PORT), _free_port(_WEB_PORT)
        options = ["--bind", _LOOPBACK, "--port", str(port), "--server-memory-limit", _MEMORY]
        options += (
            ["--serve-web", "--web-viewer-port", str(web_port)] if self._target == WEB else ["--expect-data-soon"]
        )
        with tempfile.TemporaryFile() as said:
            self._child = subprocess.Popen(
                [sys.executable, "-m", "avp_sb3.rerun.guard", str(program()), *options],
                stdin=subprocess.PIPE,
                stdout=said,
                stderr=said,
                start_new_session=True,  # Ctrl-C is meant for the training, which closes the viewer itself.
            )
            atexit.register(self.close)
            try:
                self._wait_until_it_listens(port, said)
                if self._target == WEB:
                    self._wait_until_it_listens(web_port, said)
            except LiveError:
                self.close()
                raise
        self._address = (_LOOPBACK, port)
        if self._target == WEB:
            source = quote(f"rerun+http://{_LOOPBACK}:{port}/proxy", safe="")
            self.url = f"http://{_LOOPBACK}:{web_port}/?url={source}"
            print(f"Rerun web viewer: {self.url}")

    def _wait_until_it_listens(self, port: int, said: IO[bytes]) -> None:
        """Also a little longer: a window that cannot be opened ends the program after it listens."""
        until = time.monotonic() + _START_S
        while not _listens(port):
            self._check_child(said)
            if time.monotonic() > until:
                raise LiveError(f"the Rerun program did not listen on port {port} within {_START_S:.0f} s")
            time.sleep(0.05)
        time.sleep(_STAYS_S)
        self._check_child(said)

    def _check_child(self, said: IO[bytes]) -> None:
        assert self._child is not None
        if (code := self._child.poll()) is None:
            return
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines() or ["no message"]
        hint = "; live='web' needs no display" if self._target == VIEWER else ""
        raise LiveError(f"live={self._target!r}: the Rerun program ended with code {code}: {lines[-1].strip()}{hint}")


def _host_and_port(target: str) -> tuple[str, int]:
    try:
        parts = urlsplit(target)
        host, port = parts.hostname, parts.port or _PORT
    except ValueError:
        host, port, parts = None, 0, urlsplit("")
    if parts.scheme != "rerun+http" or not host or parts.path != "/proxy":
        raise UsageError(f"live: expected 'viewer', 'web' or 'rerun+http://HOST:PORT/proxy', got {target!r}")
    return host, port


def program() -> Path:
    """Rerun's own program; the script on the path would leave it running when it is stopped."""
    if chosen := os.environ.get("RERUN_CLI_PATH"):
        return Path(chosen)
    package = importlib.util.find_spec("rerun_cli")
    for folder in (package.submodule_search_locations or []) if package else []:
        for name in ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun"):
            if (Path(folder) / name).is_file():
                return Path(folder) / name
    raise LiveError("the program of the package rerun-sdk is missing; install it again")


def _free_port(preferred: int) -> int:
    for port in (preferred, 0):
        with socket.socket() as candidate:
            candidate.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                candidate.bind((_LOOPBACK, port))
            except OSError:
                continue
            return candidate.getsockname()[1]
    raise LiveError(f"no free port on {_LOOPBACK}")


def _listens(port: int) -> bool:
    with socket.socket() as candidate:
        candidate.settimeout(1.0)
        return candidate.connect_ex((_LOOPBACK, port)) == 0
