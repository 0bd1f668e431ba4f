import json
import os
import pickle
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio_room import write_room

pytest.importorskip("nerfstudio")

from nerfstudio.utils.eval_utils import eval_load_checkpoint

from avp_habitat import command
from avp_nerfstudio.log import main as log
from avp_nerfstudio.method.checkpoints import allow_checkpoints, loading_fault

BEFORE = Path(__file__).parent / "data/before/nerfstudio"


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


def test_nerfstudio_loads_its_own_checkpoints_and_nothing_else(tmp_path):
    """By what every `ns-` command but ns-train loads its checkpoint with."""
    path, target = tmp_path / "step-000000003.ckpt", tmp_path / "made-by-a-checkpoint"
    where = SimpleNamespace(load_dir=tmp_path, load_step=3), SimpleNamespace(load_pipeline=print)
    checkpoint(path)
    assert eval_load_checkpoint(*where) == (path, 3)
    checkpoint(path, payload=RunsCode(target))
    with pytest.raises(pickle.UnpicklingError) as error:
        eval_load_checkpoint(*where)
    assert not target.exists()
    text = loading_fault(path, error.value)
    assert re.match(f"{path}: expected the tensors and numbers .*found (posix|os).mkdir, which could run code", text)
    assert "\n" not in text


@pytest.mark.filterwarnings("ignore")  # of nerfstudio's own command
def test_a_training_of_before_the_modules_moved_opens(tmp_path, monkeypatch):
    """Made at 78b2946 from the same room: its config.yml names avp_nerfstudio.trainer and the like."""
    write_room(tmp_path / "room", frames=4)
    folder = tmp_path / "outputs/e/avp-nerfacto/t"
    (folder / "nerfstudio_models").mkdir(parents=True)
    shutil.copy(BEFORE / "config.yml", folder)
    shutil.copy(BEFORE / "step-000000011.ckpt", folder / "nerfstudio_models")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    from nerfstudio.scripts.eval import ComputePSNR

    ComputePSNR(load_config=folder / "config.yml", output_path=tmp_path / "scores.json").main()
    theirs = json.loads((tmp_path / "scores.json").read_text())["results"]
    # What ns-eval gave at 78b2946.
    assert theirs["psnr"] == pytest.approx(16.1335, abs=1e-3)
    assert command.run(log, [str(folder), "--mlflow", "off", "--output", str(tmp_path / "held")]) == 0
    table = json.loads((tmp_path / "held/heldout.json").read_text())
    assert table["mean"]["psnr"] == pytest.approx(16.1335, abs=1e-3)
