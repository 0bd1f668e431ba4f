"""The shape of a trained model: in which frame it is looked at, and that a real training has one."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("nerfstudio")

from avp_habitat import collect, command
from avp_habitat.errors import RolloutError
from avp_habitat.metrics import GEOMETRY
from avp_habitat.poses import z_up_to_y_up
from avp_habitat.simulators.registry import SimulatorChoice, open_simulator
from avp_nerfstudio import geometry, reconstruct
from avp_nerfstudio.data.dataparser import AVPDataParserConfig
from avp_nerfstudio.method.shape import model_figures, rollout_of


@pytest.fixture(scope="module")
def simulator():
    return open_simulator(SimulatorChoice(), "builtin:3")


class TrueModel:
    """Answers nerfstudio's rays, Z up and scaled, with the scene's own distances."""

    def __init__(self, simulator, scale):
        self._simulator, self._scale = simulator, scale

    def modules(self):
        return iter(())

    def get_outputs_for_camera(self, camera):
        rays = camera.generate_rays(camera_indices=0, keep_shape=True)
        shape = rays.origins.shape
        turn = z_up_to_y_up(np.eye(4))[:3, :3]
        origins = rays.origins.numpy().reshape(-1, 3).astype(np.float64) / self._scale @ turn.T
        directions = rays.directions.numpy().reshape(-1, 3).astype(np.float64) @ turn.T
        found = self._simulator.distance(origins, directions) * self._scale
        depth = torch.from_numpy(found.reshape(*shape[:-1], 1))
        return {"depth": depth, "accumulation": torch.ones_like(depth)}


def pipeline_of(model, scale, parser):
    manager = SimpleNamespace(
        config=SimpleNamespace(dataparser=parser),
        train_dataparser_outputs=SimpleNamespace(dataparser_scale=scale),
    )
    return SimpleNamespace(model=model, datamanager=manager, device="cpu")


@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_a_model_that_is_the_scene_is_scored_as_the_scene(simulator, rollout, scale):
    pipeline = pipeline_of(TrueModel(simulator, scale), scale, AVPDataParserConfig(data=rollout))
    found = model_figures(pipeline, rollout_of(pipeline), simulator)
    assert found["accuracy_m"] < 0.01
    assert found["precision"] > 0.98
    assert found["completion_ratio"] > 0.7


def test_a_model_of_another_parser_has_no_known_frame(simulator):
    pipeline = pipeline_of(TrueModel(simulator, 1.0), 1.0, SimpleNamespace())
    with pytest.raises(RolloutError, match="avp-data, whose frame is the rollout's, found SimpleNamespace"):
        rollout_of(pipeline)


@pytest.fixture(scope="module")
def rollout(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rollouts") / "rollout"
    words = ["--scene", "builtin:3", "--policy", "nbv", "--budget", "12", "--width", "32", "--height", "24"]
    assert command.run(collect.main, [*words, "--out", str(folder)]) == 0
    return folder


def test_a_reconstruction_measures_its_shape_and_a_checkpoint_has_the_same(rollout, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    out = tmp_path / "out"
    words = [str(rollout), "--out", str(out), "--iterations", "40", "--scene", "builtin:3", "--keep-checkpoint"]
    assert command.run(reconstruct.main, words) == 0
    assert "completion_ratio" in capsys.readouterr().out
    kept = json.loads((out / "scores.json").read_text())["geometry"]
    assert set(kept) == set(GEOMETRY)
    assert kept["precision"] > 0.05
    assert command.run(geometry.main, [str(out), "--scene", "builtin:3", "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert {name: again[name] for name in GEOMETRY} == pytest.approx(kept, rel=0.02)
    assert command.run(geometry.main, [str(out), "--scene", "builtin:4"]) == 1
    assert "expected a rollout of builtin:4, found one of builtin:3" in capsys.readouterr().err


def test_a_rollout_of_another_scene_is_refused_before_it_is_trained_on(rollout, tmp_path, capsys):
    words = [str(rollout), "--out", str(tmp_path / "out"), "--iterations", "3", "--scene", "builtin:4"]
    assert command.run(reconstruct.main, words) == 1
    assert "expected a rollout of builtin:4, found one of builtin:3 of another digest" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
