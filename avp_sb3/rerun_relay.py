"""A connection to a viewer that can be cut: bytes pass through a socket of ours on loopback."""

import socket
import threading
import time
from contextlib import suppress

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
