import json

import pytest

from avp_nerfstudio.method.scores import Scores, ScoresError, lpips_weights_path, read_scores


def write(path, results):
    path.write_text(json.dumps({"method_name": "avp-nerfacto", "results": results}))
    return path


def test_all_three_scores_are_read(tmp_path):
    path = write(tmp_path / "s.json", {"psnr": 25.5, "psnr_std": 2, "ssim": 0.9, "lpips": 0.04, "fps": 1.0})
    assert read_scores(path) == Scores(psnr=25.5, ssim=0.9, lpips=0.04, lpips_reason=None)


def test_lpips_that_was_not_computed_is_none_with_a_reason(tmp_path, monkeypatch):
    path = write(tmp_path / "s.json", {"psnr": 25.5, "ssim": 0.9})
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert read_scores(path).lpips is None
    assert f"AlexNet's weights are not in {lpips_weights_path()}" in str(read_scores(path).lpips_reason)
    assert lpips_weights_path().is_relative_to(tmp_path)
    lpips_weights_path().parent.mkdir(parents=True)
    lpips_weights_path().touch()
    assert "its output says why" in str(read_scores(path).lpips_reason)
    assert read_scores(path, lpips_reason="no weights").lpips_reason == "no weights"


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "found no such file"),
        ("{", "could not read it"),
        ("[]", "found none of its `results`"),
        ('{"results": 3}', "expected `results` to be an object"),
        ('{"results": {"psnr": 20}}', "finite number for ssim, found None"),
        ('{"results": {"psnr": NaN, "ssim": 1}}', "finite number for psnr, found nan"),
    ],
)
def test_a_file_that_is_not_ns_evals_is_an_error_that_names_it(tmp_path, content, text):
    path = tmp_path / "s.json"
    if content is not None:
        path.write_text(content)
    with pytest.raises(ScoresError, match=text) as error:
        read_scores(path)
    assert str(path) in str(error.value)
