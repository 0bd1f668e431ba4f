import json
import time

import pytest
import torch

pytest.importorskip("nerfstudio")

from avp_habitat.errors import AVPError
from avp_nerfstudio.method.scores import OptionalLPIPS, lpips_weights_path, read_scores


def write(path, results):
    path.write_text(json.dumps({"method_name": "avp-nerfacto", "results": results}))
    return path


def test_the_scores_of_ns_eval_are_read_and_lpips_may_be_missing(tmp_path, monkeypatch):
    path = write(tmp_path / "s.json", {"psnr": 25.5, "psnr_std": 2, "ssim": 0.9, "lpips": 0.04, "fps": 1.0})
    assert read_scores(path) == ({"psnr": 25.5, "ssim": 0.9, "lpips": 0.04}, None)
    write(path, {"psnr": 25.5, "ssim": 0.9})
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert read_scores(path) == ({"psnr": 25.5, "ssim": 0.9}, f"AlexNet's weights are not in {lpips_weights_path()}")
    lpips_weights_path().parent.mkdir(parents=True)
    lpips_weights_path().touch()
    assert "output says why" in str(read_scores(path)[1])


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "FileNotFoundError"),
        ("{", "JSONDecodeError"),
        ('{"results": 3}', "TypeError"),
        ('{"results": {"psnr": 20}}', "KeyError.*ssim"),
        ('{"results": {"psnr": NaN, "ssim": 1}}', "finite number for psnr, found nan"),
    ],
)
def test_a_file_that_is_not_ns_evals_is_an_error_that_names_it(tmp_path, content, text):
    path = tmp_path / "s.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(AVPError, match=text) as error:
        read_scores(path)
    assert str(path) in str(error.value)


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
