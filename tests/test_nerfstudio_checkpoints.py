import collections
import os
import pickle
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from nerfstudio.utils.eval_utils import eval_load_checkpoint

from avp_habitat.errors import AVPError
from avp_nerfstudio.method.checkpoints import UnsafeCheckpointError, allow_checkpoints


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


def nerfstudio_loads(folder):
    """What every `ns-` command but ns-train loads its checkpoint with."""
    return eval_load_checkpoint(SimpleNamespace(load_dir=folder, load_step=3), SimpleNamespace(load_pipeline=print))


@pytest.mark.parametrize(
    ("payload", "name"),
    [
        (RunsCode, "(posix|os).mkdir"),
        (lambda target: collections.UserDict(target=str(target)), "collections.UserDict"),
        (lambda target: np.zeros(2), "numpy._core.multiarray._reconstruct"),
    ],
    ids=["a call", "a class", "an array"],
)
def test_nerfstudio_refuses_every_other_type_by_name_in_one_line(tmp_path, payload, name):
    target = tmp_path / "made-by-a-checkpoint"
    path = checkpoint(tmp_path / "step-000000003.ckpt", payload=payload(target))
    with pytest.raises(UnsafeCheckpointError, match=f"found {name}, which could run code") as error:
        nerfstudio_loads(tmp_path)
    assert isinstance(error.value, AVPError)
    assert str(error.value.code).startswith(f"error: {path}: expected the tensors and numbers")
    assert "\n" not in str(error.value.code)
    assert not target.exists()


def test_nerfstudio_loads_its_own_checkpoints(tmp_path, capsys):
    path = checkpoint(tmp_path / "step-000000003.ckpt")
    assert nerfstudio_loads(tmp_path) == (path, 3)


def test_other_errors_of_nerfstudio_stay_what_they_are(tmp_path):
    path = checkpoint(tmp_path / "step-000000003.ckpt")
    path.write_bytes(path.read_bytes()[:-80])
    with pytest.raises(RuntimeError, match="PytorchStreamReader"):
        nerfstudio_loads(tmp_path)


def test_other_programs_get_torchs_own_refusal_and_their_own_way(tmp_path):
    path = checkpoint(tmp_path / "a.ckpt", payload=collections.UserDict(a=1))
    with pytest.raises(pickle.UnpicklingError, match="Weights only load failed") as error:
        torch.load(path)
    assert not isinstance(error.value, SystemExit)
    assert torch.load(path, weights_only=False)["payload"] == {"a": 1}
