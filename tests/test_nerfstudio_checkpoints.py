import os
import pickle

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from avp_nerfstudio.checkpoints import allow_checkpoints


class RunsCode:
    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.fixture
def nothing_allowed():
    before = torch.serialization.get_safe_globals()
    torch.serialization.clear_safe_globals()
    yield
    torch.serialization.clear_safe_globals()
    torch.serialization.add_safe_globals(before)


def checkpoint(path, **extra):
    scheduler = {"base_lrs": [0.01], "_last_lr": [np.float64(0.0095)], "last_epoch": 3}
    torch.save({"step": 3, "schedulers": {"fields": scheduler}, "pipeline": {"w": torch.ones(2)}, **extra}, path)
    return path


def test_the_learning_rates_of_a_checkpoint_pass_the_safe_loader(tmp_path, nothing_allowed):
    path = checkpoint(tmp_path / "a.ckpt")
    with pytest.raises(pickle.UnpicklingError, match=r"numpy.*scalar"):
        torch.load(path)
    allow_checkpoints()
    loaded = torch.load(path)
    assert loaded["schedulers"]["fields"]["_last_lr"] == [0.0095]


def test_code_in_a_checkpoint_is_still_refused(tmp_path, nothing_allowed):
    allow_checkpoints()
    target = tmp_path / "made-by-a-checkpoint"
    with pytest.raises(pickle.UnpicklingError, match="mkdir"):
        torch.load(checkpoint(tmp_path / "a.ckpt", payload=RunsCode(target)))
    assert not target.exists()


def test_importing_the_plugin_is_what_allows_checkpoints(tmp_path):
    import avp_nerfstudio.plugin  # noqa: F401

    assert torch.load(checkpoint(tmp_path / "a.ckpt"))["step"] == 3
