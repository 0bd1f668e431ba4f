import time

import pytest
import torch

pytest.importorskip("nerfstudio")

from avp_nerfstudio.method.scores import OptionalLPIPS


@pytest.fixture
def no_way_to_the_weights(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    for name in ("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    return tmp_path


def test_weights_that_cannot_be_had_leave_lpips_out_and_say_why_once(no_way_to_the_weights, capsys):
    lpips = OptionalLPIPS(normalize=True)
    start = time.monotonic()
    values = [lpips(torch.rand(1, 3, 64, 64), torch.rand(1, 3, 64, 64)) for _ in range(2)]
    assert all(torch.isnan(value) for value in values)
    assert time.monotonic() - start < 30
    said = capsys.readouterr().out
    assert said.count("LPIPS is not computed: AlexNet's weights are not in") == 1
    assert str(no_way_to_the_weights / "hub" / "checkpoints") in said
    assert "TORCH_HOME" in said


def test_pictures_too_small_for_alexnet_leave_lpips_out():
    lpips = OptionalLPIPS(normalize=True)
    assert torch.isnan(lpips(torch.rand(1, 3, 24, 32), torch.rand(1, 3, 24, 32)))
    assert lpips.reason is not None
    assert "32x24 pixels" in lpips.reason


def test_lpips_tells_pictures_apart_and_stays_out_of_checkpoints(shared, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(shared / "torch_home"))
    torch.manual_seed(0)
    picture, noise = torch.rand(1, 3, 64, 64), torch.rand(1, 3, 64, 64)
    lpips = OptionalLPIPS(normalize=True)
    assert float(lpips(picture, picture)) == pytest.approx(0, abs=1e-6)
    assert float(lpips(picture, noise)) > 0.1
    assert lpips.reason is None
    assert lpips.state_dict() == {}
