import io
import threading

import numpy as np
import pytest
from PIL import Image

from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import images
from avp_habitat.rollout.images import GREY_16, RGB_8, check_png_contents, check_png_structure, encode_png
from avp_habitat.rollout.writing import RolloutWriter

CAMERA = Intrinsics.from_hfov(12, 8, hfov_deg=75)
RANDOM = np.random.default_rng(0)
PICTURES = {
    "noise": RANDOM.integers(0, 256, (7, 5, 3), dtype=np.uint8),
    "one pixel": np.array([[[1, 2, 3]]], np.uint8),
    "one row": RANDOM.integers(0, 256, (1, 9, 3), dtype=np.uint8),
    "long runs": np.repeat(np.repeat(RANDOM.integers(0, 256, (3, 2, 3), dtype=np.uint8), 300, 0), 400, 1),
    "every other column": RANDOM.integers(0, 256, (6, 8, 3), dtype=np.uint8)[:, ::2],
    "upside down": RANDOM.integers(0, 256, (6, 8, 3), dtype=np.uint8)[::-1],
    "depth": RANDOM.integers(0, 1 << 16, (7, 5), dtype=np.uint16),
    "a ramp": np.arange(640, dtype=np.uint16)[None] * 100 + np.zeros((480, 1), np.uint16),
    "transposed": RANDOM.integers(0, 1 << 16, (4, 9), dtype=np.uint16).T,
}


@pytest.mark.parametrize("name", PICTURES)
def test_another_program_reads_the_very_pixels_that_were_encoded(tmp_path, name):
    pixels = PICTURES[name]
    kind = RGB_8 if pixels.ndim == 3 else GREY_16
    encoded = encode_png(pixels, kind)
    with Image.open(io.BytesIO(encoded)) as image:
        assert image.mode == ("RGB" if kind is RGB_8 else "I;16")
        np.testing.assert_array_equal(np.asarray(image), pixels)
    (tmp_path / "a.png").write_bytes(encoded)
    check_png_structure(str(tmp_path / "a.png"), width=pixels.shape[1], height=pixels.shape[0], kind=kind)
    check_png_contents(tmp_path / "a.png")


def test_a_smooth_picture_takes_a_small_part_of_its_bytes(tmp_path):
    row = np.linspace(0, 200, 640) + np.linspace(0, 50, 480)[:, None]
    images.write_rgb(tmp_path / "rgb.png", np.repeat(row.astype(np.uint8)[..., None], 3, axis=2))
    images.write_depth(tmp_path / "depth.png", 1 + row / 100)
    assert (tmp_path / "rgb.png").stat().st_size < 640 * 480 * 3 / 15
    assert (tmp_path / "depth.png").stat().st_size < 640 * 480 * 2 / 15


def test_every_view_of_a_long_rollout_is_in_its_own_file(tmp_path):
    """Many more than are written at a time."""
    with RolloutWriter(tmp_path / "r", CAMERA) as writer:
        for k in range(60):
            writer.add_frame(np.full((8, 12, 3), k, np.uint8), np.full((8, 12), 1.0 + k), np.eye(4))
        writer.add_step({"step": 1})
        assert [images.read_rgb(view.image)[0, 0, 0] for view in writer.views(heldout=False)] == list(range(60))
        writer.publish({})
    found = sorted((tmp_path / "r" / "depth").iterdir())
    assert [images.read_depth(path)[0, 0] for path in found] == [pytest.approx(1.0 + k) for k in range(60)]


def test_a_slow_disk_holds_the_rendering_up_instead_of_filling_the_memory(tmp_path, monkeypatch):
    written, most, lock = [], [], threading.Event()

    def slow(path, picture):
        lock.wait(0.01)
        written.append(path)

    monkeypatch.setattr("avp_habitat.rollout.images.write_rgb", slow)
    monkeypatch.setattr("avp_habitat.rollout.images.write_depth", slow)
    with RolloutWriter(tmp_path / "r", CAMERA) as writer:
        for k in range(40):
            writer.add_frame(np.zeros((8, 12, 3), np.uint8), np.ones((8, 12)), np.eye(4))
            most.append(2 * (k + 1) - len(written))
        writer.publish({})
    assert 2 <= max(most) <= 12
    assert len(written) == 80


def test_pictures_of_an_abandoned_rollout_are_not_written_after_its_end(tmp_path, monkeypatch):
    real = images.write_depth

    def slow(path, depth):
        threading.Event().wait(0.02)
        real(path, depth)

    monkeypatch.setattr("avp_habitat.rollout.images.write_depth", slow)
    with RolloutWriter(tmp_path / "r", CAMERA) as writer:
        for _ in range(4):
            writer.add_frame(np.zeros((8, 12, 3), np.uint8), np.ones((8, 12)), np.eye(4))
    threading.Event().wait(0.1)
    assert list(tmp_path.iterdir()) == []
