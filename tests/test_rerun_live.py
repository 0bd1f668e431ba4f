import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.parse
import urllib.request
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import rerun as rr
import rerun.blueprint as rrb
from rrd import rows, verify
from tracking import ppo

from avp_habitat.errors import UsageError
from avp_sb3 import RerunCallback
from avp_sb3.rerun.live import LiveError, LiveViewer, Relay, program

TESTS = Path(__file__).parent


@contextmanager
def receiver(folder):
    """A Rerun server that keeps what it is sent in `received.rrd`, and its port."""
    port = free_port()
    options = ["--save", folder / "received.rrd", "--bind", "127.0.0.1", "--port", str(port)]
    with open(folder / "said.txt", "w") as said:
        server = subprocess.Popen([program(), *options], stdout=said, stderr=said)
    try:
        wait_for(lambda: listens(port))
        yield server, port
    finally:
        server.kill()
        server.wait()


def free_port():
    with socket.socket() as candidate:
        candidate.bind(("127.0.0.1", 0))
        return candidate.getsockname()[1]


def listens(port, host="127.0.0.1"):
    with socket.socket() as candidate:
        return candidate.connect_ex((host, port)) == 0


def wait_for(condition, seconds=60):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.05)


def listening():
    """Address and port of every socket of this machine that listens, IPv4 and IPv6, as the kernel lists them."""
    lines = [line for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]]
    fields = [line.split() for line in lines]
    return {tuple(field[1].split(":")) for field in fields if field[3] == "0A"}


def address(port):
    return f"rerun+http://127.0.0.1:{port}/proxy"


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_an_open_viewer_gets_what_the_file_gets(tmp_path):
    def contents(name):
        with suppress(RuntimeError):  # Of a file that ends within a message, for now.
            return [
                [(time, value.tolist()) for time, value in rows(tmp_path / name, entity, component)]
                for entity, component in (
                    ("/plots/coverage", "Scalars:scalars"),
                    ("/metrics/coverage", "Scalars:scalars"),
                    ("/world/camera/rgb", "EncodedImage:blob"),
                    ("/world/floor", "Points3D:colors"),
                )
            ]

    with receiver(tmp_path) as (_, port):
        callback = RerunCallback(tmp_path / "a.rrd", live=address(port), every=2, max_share=1, pictures=2, width=16)
        ppo().learn(64, callback=callback)
        callback.close()
        verify(tmp_path / "a.rrd")
        kept = contents("a.rrd")
        assert kept is not None
        assert all(kept)
        wait_for(lambda: contents("received.rrd") == kept)


@pytest.mark.slow
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGSTOP])
def test_a_viewer_that_goes_away_or_stops_reading_does_not_stop_the_training(tmp_path, ending):
    """In a process of its own: Rerun by itself would keep it from ending for ever."""
    with receiver(tmp_path) as (server, port):
        training = subprocess.Popen(
            [sys.executable, "-c", _TRAINING, str(tmp_path / "a.rrd"), address(port)],
            cwd=TESTS,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert training.stdout is not None
        assert training.stdout.readline().strip() == "half"
        server.send_signal(ending)
        _, said = training.communicate("go\n", timeout=300)
    assert training.returncode == 0
    # What is logged after a stop may still fit into the buffers of the connection.
    assert said.count("RerunCallback: lost the live viewer") == (1 if ending == signal.SIGKILL else 0)
    verify(tmp_path / "a.rrd")
    episodes = {time for time, _ in rows(tmp_path / "a.rrd", "/plots/coverage", "Scalars:scalars", "episode")}
    assert len(episodes) >= 24


_TRAINING = """
import sys
from stable_baselines3.common.callbacks import BaseCallback
from tracking import ppo
from avp_sb3 import RerunCallback

class Pause(BaseCallback):
    def _on_step(self):
        if self.n_calls == 64:
            print("half", flush=True)
            sys.stdin.readline()
        return True

live = RerunCallback(sys.argv[1], live=sys.argv[2], every=1, max_share=1, pictures=1, width=32, height=24)
ppo().learn(192, callback=[live, Pause()])
"""


def test_a_relay_to_somebody_who_does_not_read_is_lost_and_can_be_cut():
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        relay = Relay(*deaf.getsockname(), timeout_s=5, patience_s=0.2)
        with socket.create_connection(("127.0.0.1", relay.port)) as near:
            near.sendall(b"a" * 1000)
            assert not relay.lost
            near.settimeout(1)
            with pytest.raises(TimeoutError):
                near.sendall(bytes(100_000_000))
            wait_for(lambda: relay.lost)
            relay.cut()
            with pytest.raises(OSError, match=r"[Bb]roken pipe|reset"):
                near.sendall(bytes(100_000_000))


def test_a_relay_passes_bytes_both_ways():
    with socket.create_server(("127.0.0.1", 0)) as other:
        relay = Relay(*other.getsockname(), timeout_s=5, patience_s=5)
        with socket.create_connection(("127.0.0.1", relay.port)) as near, other.accept()[0] as far:
            near.sendall(b"there")
            assert far.recv(5, socket.MSG_WAITALL) == b"there"
            far.sendall(b"back")
            assert near.recv(4, socket.MSG_WAITALL) == b"back"
            far.shutdown(socket.SHUT_RDWR)
            wait_for(lambda: relay.lost)


def test_a_web_viewer_is_served_on_loopback_only_and_ends_with_the_callback(tmp_path, capsys):
    before = listening()
    callback = RerunCallback(tmp_path / "a.rrd", live="web", pictures=0)
    ppo().learn(64, callback=callback)
    url = next(word for word in capsys.readouterr().out.split() if word.startswith("http://127.0.0.1:"))
    new = listening() - before
    # One page, one server, which stay after the training.
    assert len(new) >= 2
    assert {host for host, _ in new} == {"0100007F"}
    with urllib.request.urlopen(url) as page:
        assert b"rerun" in page.read().lower()
    port = urllib.parse.urlsplit(url).port
    callback.close()
    wait_for(lambda: not listens(port))


def test_a_server_does_not_outlive_a_training_that_is_killed(tmp_path):
    command = (
        "import os, signal; from avp_sb3.rerun.live import LiveViewer; import rerun.blueprint as rrb;"
        "viewer = LiveViewer('web'); viewer.open('some', rrb.Blueprint()); print(viewer.url, flush=True);"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", command], stdout=subprocess.PIPE, text=True)
    assert done.returncode == -signal.SIGKILL
    port = urllib.parse.urlsplit(done.stdout.split()[-1]).port
    wait_for(lambda: not listens(port))


def test_a_window_without_a_display_is_an_error_at_the_start(tmp_path, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(LiveError, match=r"live='viewer': the Rerun program ended .*DISPLAY.*; live='web' needs"):
        ppo().learn(64, callback=RerunCallback(tmp_path / "a.rrd", live="viewer"))


def test_an_address_where_nobody_listens_is_an_error_at_the_start(tmp_path):
    port = free_port()
    with pytest.raises(LiveError, match=rf"rerun\+http://127.0.0.1:{port}/proxy: no Rerun viewer there .*`rerun`"):
        ppo().learn(64, callback=RerunCallback(tmp_path / "a.rrd", live=address(port)))


@pytest.mark.parametrize("delay_s", [0, 0.2])
def test_an_address_where_something_else_listens_is_an_error_at_the_start(delay_s):
    """Also when it reads first: Rerun has flushed what it had to send by then, and sees nothing wrong."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        viewer = LiveViewer(address(other.getsockname()[1]))
        other.settimeout(60)

        def answer():
            connection, _ = other.accept()
            if delay_s:
                connection.recv(1 << 16)
                time.sleep(delay_s)
            connection.sendall(b"HTTP/1.1 400 Bad Request\r\n\r\n")
            connection.close()

        threading.Thread(target=answer, daemon=True).start()
        with pytest.raises(LiveError, match="what listens there is no Rerun viewer"):
            viewer.open("some", rrb.Blueprint())


def test_an_address_where_somebody_listens_and_says_nothing_is_an_error_at_the_start(monkeypatch):
    monkeypatch.setattr("avp_sb3.rerun.live._ANSWER_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        viewer = LiveViewer(address(silent.getsockname()[1]))
        with pytest.raises(LiveError, match=r"no Rerun viewer .it does not answer with HTTP/2"):
            viewer.open("some", rrb.Blueprint())


def test_a_program_that_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("RERUN_CLI_PATH", str(tmp_path / "rerun"))
    with pytest.raises(LiveError, match=r"the Rerun program ended with code 1: .*No such file"):
        LiveViewer("web").open("some", rrb.Blueprint())


@pytest.mark.parametrize(
    "live", ["", "window", "http://127.0.0.1:9876", "rerun+http:///proxy", "rerun+http://a:b/proxy"]
)
def test_an_unknown_way_of_watching_is_refused(live):
    with pytest.raises(UsageError, match=r"live: expected 'viewer', 'web' or 'rerun\+http://HOST:PORT/proxy', got "):
        RerunCallback(live=live)


def test_reruns_own_servers_listen_on_all_addresses():
    """Why the servers here are children with `--bind`; when this fails, they need not be any more."""
    before = listening()
    recording = rr.RecordingStream("avp", recording_id="some")
    recording.serve_grpc(grpc_port=free_port())
    wait_for(lambda: listening() - before)
    assert "00000000" in {host for host, _ in listening() - before}
    recording.disconnect()
