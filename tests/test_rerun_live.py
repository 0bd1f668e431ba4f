import socket
import subprocess
import time
import urllib.parse
import urllib.request
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from rrd import PROGRAM, rows, verify
from stable_baselines3.common.callbacks import BaseCallback
from tracking import ppo

from avp_habitat.errors import UsageError
from avp_sb3 import RerunCallback
from avp_sb3.callbacks.rerun import RecordingError


@contextmanager
def receiver(folder):
    """A Rerun server that keeps what it is sent in `received.rrd`, and its port."""
    port = free_port()
    options = ["--save", folder / "received.rrd", "--bind", "127.0.0.1", "--port", str(port)]
    with open(folder / "said.txt", "w") as said:
        server = subprocess.Popen([PROGRAM, *options], stdout=said, stderr=said)
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


class Kill(BaseCallback):
    """Kills a program in the middle of a training."""

    def __init__(self, program):
        super().__init__()
        self.program = program

    def _on_step(self):
        if self.n_calls == 64:
            self.program.kill()
            self.program.wait()
        return True


def test_a_viewer_that_goes_away_does_not_stop_the_training(tmp_path, capsys):
    with receiver(tmp_path) as (server, port):
        callback = RerunCallback(tmp_path / "a.rrd", live=address(port), every=1, max_share=1, pictures=0)
        ppo().learn(128, callback=[callback, Kill(server)])
        callback.close()
    assert capsys.readouterr().err.count(f"RerunCallback: {address(port)}: gRPC connection ") == 1
    verify(tmp_path / "a.rrd")
    episodes = {time for time, _ in rows(tmp_path / "a.rrd", "/plots/coverage", "Scalars:scalars", "episode")}
    assert episodes == set(range(1, len(episodes) + 1))
    assert len(episodes) >= 16


def test_a_web_viewer_is_served_whose_data_is_on_loopback_only_and_ends_with_the_callback(tmp_path, capsys):
    before = listening()
    callback = RerunCallback(tmp_path / "a.rrd", live="web", pictures=0)
    model = ppo()
    model.learn(64, callback=callback)
    url = next(word for word in capsys.readouterr().out.split() if word.startswith("http://127.0.0.1:"))
    with urllib.request.urlopen(url) as page:
        assert b"rerun" in page.read().lower()
    (data,) = urllib.parse.parse_qs(urllib.parse.urlsplit(url).query)["url"]
    port = urllib.parse.urlsplit(data).port
    assert data == address(port)
    # It stays after the training. Rerun's page, without any data, cannot be told where to listen.
    hosts = {host for host, its_port in listening() - before if int(its_port, 16) == port}
    assert hosts == {"0100007F"}
    model.learn(64, callback=callback, reset_num_timesteps=False)
    wait_for(lambda: not listens(port))
    again = next(word for word in capsys.readouterr().out.split() if word.startswith("http://127.0.0.1:"))
    assert urllib.parse.urlsplit(again).port == urllib.parse.urlsplit(url).port
    callback.close()
    wait_for(lambda: {host for host, _ in listening() - before} == {"00000000"})


def test_a_window_without_a_display_is_an_error_at_the_start(tmp_path, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(RecordingError, match=r"live='viewer': no Rerun viewer there .*; live='web' needs no display"):
        ppo().learn(64, callback=RerunCallback(tmp_path / "a.rrd", live="viewer"))


def test_an_address_where_nobody_listens_is_an_error_at_the_start(tmp_path):
    port = free_port()
    with pytest.raises(
        RecordingError, match=rf"live='rerun\+http://127.0.0.1:{port}/proxy': no Rerun viewer .*`rerun`"
    ):
        ppo().learn(64, callback=RerunCallback(tmp_path / "a.rrd", live=address(port)))


@pytest.mark.parametrize("live", ["", "window", "http://127.0.0.1:9876", "rerun+http://127.0.0.1:9876"])
def test_an_unknown_way_of_watching_is_refused(live):
    with pytest.raises(UsageError, match=r"live: expected 'viewer', 'web' or 'rerun\+http://HOST:PORT/proxy', got "):
        RerunCallback(live=live)
