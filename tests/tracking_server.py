"""A real `mlflow server` on loopback, that can be killed and started again, and a real PostgreSQL behind it."""

import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from contextlib import suppress
from pathlib import Path

WAIT_S = 120


def free_port():
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


class Server:
    def __init__(self, folder, backend=None):
        self.folder = Path(folder)
        self.backend = backend or f"sqlite:///{self.folder}/server.db"
        self.port = free_port()
        self.address = f"http://127.0.0.1:{self.port}"
        self.process = None

    def start(self):
        log = (self.folder / "server.log").open("ab")
        options = ["--host", "127.0.0.1", "--port", str(self.port), "--workers", "1"]
        stores = ["--backend-store-uri", self.backend, "--artifacts-destination", str(self.folder / "artifacts")]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mlflow", "server", *options, *stores],
            stdout=log,
            stderr=log,
            cwd=self.folder,
            start_new_session=True,
            env={**os.environ, "MLFLOW_DISABLE_TELEMETRY": "true", "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"},
        )
        until = time.monotonic() + WAIT_S
        while time.monotonic() < until:
            with suppress(OSError), urllib.request.urlopen(f"{self.address}/health", timeout=2) as answer:
                assert answer.status == 200
                return self
            assert self.process.poll() is None, (self.folder / "server.log").read_text()
            time.sleep(0.2)
        raise TimeoutError((self.folder / "server.log").read_text())

    def signal(self, number):
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, number)

    def kill(self):
        """The server and its workers, as a power cut would end them."""
        self.signal(signal.SIGKILL)
        self.process.wait()


def postgres_programs():
    """The folder of PostgreSQL's server programs, or None."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb")) if Path("/usr/lib/postgresql").is_dir() else []
    found = [path.parent for path in found] or [Path(p).parent for p in [shutil.which("initdb")] if p]
    return found[-1] if found else None


class Postgres:
    """A cluster of its own in a folder, on a free port of loopback; PostgreSQL does not run as root."""

    def __init__(self, folder):
        self.folder = Path(folder)
        self.port = free_port()
        self.address = f"postgresql+psycopg2://avp@127.0.0.1:{self.port}/postgres"
        self._bin = postgres_programs()
        self._user = {}
        if os.geteuid() == 0:
            entry = pwd.getpwnam("postgres")
            self._user = {"user": entry.pw_uid, "group": entry.pw_gid, "extra_groups": []}
            for parent in [self.folder, *self.folder.parents]:
                if parent.stat().st_uid == 0 and parent != Path("/"):
                    parent.chmod(parent.stat().st_mode | 0o011)
            os.chown(self.folder, entry.pw_uid, entry.pw_gid)

    def start(self):
        data = self.folder / "data"
        run = {"check": True, "capture_output": True, "cwd": self.folder, **self._user}
        subprocess.run([self._bin / "initdb", "-D", data, "-U", "avp", "--auth=trust", "-E", "UTF8"], **run)
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -c unix_socket_directories={self.folder} -c fsync=off"
        start = [self._bin / "pg_ctl", "-D", data, "-o", options, "-w", "-l", self.folder / "log", "start"]
        # Its own streams, because the server would keep those of pg_ctl open.
        null = subprocess.DEVNULL
        subprocess.run(start, check=True, stdout=null, stderr=null, cwd=self.folder, **self._user)
        return self

    def stop(self):
        stop = [self._bin / "pg_ctl", "-D", self.folder / "data", "-m", "immediate", "stop"]
        subprocess.run(stop, capture_output=True, cwd=self.folder, **self._user)
