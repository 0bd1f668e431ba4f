"""Rerun's web viewer, in a real browser: a training's recording is drawn, as a file and as it was sent live."""

import io
import socket
import subprocess
import time
from contextlib import contextmanager, redirect_stdout
from types import SimpleNamespace
from urllib.parse import quote

import numpy as np
import pytest
from corridor import RGB
from mlflow_page import CHROMIUM
from PIL import Image
from rrd import PROGRAM
from tracking import ppo

from avp_sb3 import RerunCallback

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(900)]

FLAGS = (
    "--no-sandbox",
    # Without a graphics card the viewer is drawn by the processor, which takes some seconds a picture.
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    # The viewer asks servers for letters, for news and for being counted.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
    "--disable-background-networking",
)
WIDTH, HEIGHT = 1000, 640
PICTURE_MS, DRAWN_S = 240_000, 300


@pytest.fixture(scope="module")
def drawing_browser(browser):
    """A browser of its own, because the others draw nothing in three dimensions."""
    found = browser.browser_type.launch(executable_path=CHROMIUM, args=list(FLAGS))
    yield found
    found.close()


@pytest.fixture(scope="module")
def training(tmp_path_factory):
    """A recording, and the page on which it was shown while it grew."""
    path, said = tmp_path_factory.mktemp("rerun") / "train.rrd", io.StringIO()
    callback = RerunCallback(path, live="web", every=1, max_share=1, pictures=2, width=64, height=48)
    try:
        with redirect_stdout(said):
            ppo().learn(64, callback=callback)
        url = next(word for word in said.getvalue().split() if word.startswith("http://127.0.0.1:"))
        yield SimpleNamespace(path=path, url=url)
    finally:
        callback.close()


@contextmanager
def served(*recordings):
    """The page of Rerun's own server of files, on loopback."""
    port, web_port = free_port(), free_port()
    options = ["--serve-web", "--bind", "127.0.0.1", "--port", str(port), "--web-viewer-port", str(web_port)]
    server = subprocess.Popen([PROGRAM, *options, *recordings], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until = time.monotonic() + 60
        while not (listens(port) and listens(web_port)):
            assert time.monotonic() < until
            time.sleep(0.05)
        yield f"http://127.0.0.1:{web_port}/?url=" + quote(f"rerun+http://127.0.0.1:{port}/proxy", safe="")
    finally:
        server.kill()
        server.wait()


def free_port():
    with socket.socket() as candidate:
        candidate.bind(("127.0.0.1", 0))
        return candidate.getsockname()[1]


def listens(port):
    with socket.socket() as candidate:
        return candidate.connect_ex(("127.0.0.1", port)) == 0


@contextmanager
def pictures(browser, url):
    """What a page shows, again and again, until it is given up."""
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})

    def watch():
        until = time.monotonic() + DRAWN_S
        while time.monotonic() < until:
            page.wait_for_timeout(2000)
            shot = page.screenshot(timeout=PICTURE_MS)
            yield np.asarray(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)

    try:
        page.goto(f"{url}&renderer=webgl")
        yield watch()
    finally:
        page.close()


def near(picture, colour, tolerance):
    return np.abs(picture - colour).max(axis=-1) <= tolerance


def found(picture):
    """Which parts of a recording of the corridor are to be seen, by their colours, where the layout puts them."""
    left, right = picture[:, : int(0.58 * WIDTH)], picture[:, int(0.62 * WIDTH) :]
    length = np.linalg.norm(left, axis=-1)
    like_the_room = (left @ RGB > 0.98 * length * np.linalg.norm(RGB)) & (length > 80)
    parts = {
        "background of the scene": near(left, (30, 32, 38), 2).mean() > 0.2,
        # Points are shaded.
        "room": like_the_room.mean() > 0.1,
        "floor": near(left, (0xAE, 0xB4, 0xC0), 12).sum() > 500,
        "camera's picture": near(right[: HEIGHT // 2], RGB, 8).mean() > 0.1,
        "actions": near(right[HEIGHT // 2 :], (0x8C, 0x7A, 0xE6), 12).sum() > 50,
    }
    return {name for name, is_there in parts.items() if is_there}


EVERYTHING = {"background of the scene", "room", "floor", "camera's picture", "actions"}


def test_a_file_is_drawn_with_its_room_floor_pictures_and_plots(drawing_browser, training):
    with served(training.path) as url, pictures(drawing_browser, url) as shown:
        assert EVERYTHING in map(found, shown)


def test_a_training_is_drawn_on_the_page_that_its_callback_serves(drawing_browser, training):
    with pictures(drawing_browser, training.url) as shown:
        assert EVERYTHING in map(found, shown)


def test_a_viewer_without_a_recording_shows_none_of_it(drawing_browser):
    with served() as url, pictures(drawing_browser, url) as shown:
        before, seen = None, []
        for picture in shown:
            # Drawn, and drawn to the end: it has its letters, and changes no more.
            if before is not None and len(np.unique(picture)) > 50 and np.array_equal(picture, before):
                break
            before = picture
            seen.append(found(picture))
        else:
            pytest.fail("the page is never drawn to its end")
        assert seen
        assert not set().union(*seen)
