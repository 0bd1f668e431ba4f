import logging

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mlflow import MlflowClient
from mlflow.entities import Metric
from mlflow.utils.validation import _validate_metric_name, _validate_param_name, _validate_tag_name
from PIL import Image as Files
from stable_baselines3.common.logger import Figure, Image, Logger
from tracking import mlflow_home

from avp_habitat.tracking.journal import spool_folder
from avp_habitat.tracking.names import SafeNames, safe_name
from avp_habitat.tracking.run import NewRun, start_run
from avp_sb3.callbacks.base import NOT_FOR, LoggedFile
from avp_sb3.callbacks.mlflow import MLflowWriter


@given(st.text(max_size=400))
def test_any_name_becomes_one_that_mlflow_takes(name):
    for validate in (_validate_metric_name, _validate_param_name, _validate_tag_name):
        validate(safe_name(name))


@given(st.lists(st.text(max_size=6), unique=True))
def test_different_names_stay_different(given_names):
    names = SafeNames()
    safe = [names[name] for name in given_names]
    assert len(set(safe)) == len(safe)
    assert safe == [names[name] for name in given_names]


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("rollout/ep_rew_mean", "rollout/ep_rew_mean"),
        ("Train Iter (time)", "Train Iter time"),
        ("a//b/../c/", "a/b/c"),
        ("reward[0]:x", "reward0_x"),
        ("", "_"),
    ],
)
def test_names_keep_what_they_can(name, safe):
    assert safe_name(name) == safe


@pytest.fixture
def run(tmp_path, monkeypatch):
    tracked = start_run(mlflow_home(tmp_path, monkeypatch), NewRun())
    yield tracked
    tracked.close("FINISHED")


def read(run):
    assert run.flush()
    return MlflowClient(run.address), run.run_id


def test_what_the_logger_dumps_is_stored_by_step(run):
    logger = Logger(None, [MLflowWriter(run)])
    for step in (10, 20):
        logger.record("train/loss (mean)", step / 4)
        logger.record("train/float32", np.float32(0.5))
        logger.record("train/tensor", torch.tensor(3))
        logger.record("host/name", "a text")
        logger.record("time/secret", 1.0, exclude=("stdout", "mlflow"))
        logger.dump(step)
    client, run_id = read(run)
    history = client.get_metric_history(run_id, "train/loss mean")
    assert [(point.step, point.value) for point in history] == [(10, 2.5), (20, 5.0)]
    data = client.get_run(run_id).data
    assert data.metrics.keys() == {"train/loss mean", "train/float32", "train/tensor"}
    assert (data.metrics["train/float32"], data.metrics["train/tensor"]) == (0.5, 3.0)
    assert data.tags["host/name"] == "a text"
    assert data.tags["avp.renamed"] == '{"train/loss (mean)": "train/loss mean"}'


def test_pictures_become_a_series_and_files_artifacts(run, tmp_path):
    logger = Logger(None, [MLflowWriter(run)])
    colours = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    for step in (10, 20):
        logger.record("eval/room:7/map", Image(colours, "HWC"))
        logger.record("eval/grey", Image(np.full((8, 9), 128, dtype=np.uint8), "HW"))
        logger.dump(step)
    (tmp_path / "best.bin").write_bytes(b"first")
    logger.record("eval/best", LoggedFile(tmp_path / "best.bin", "models/best.bin"), exclude=NOT_FOR)
    logger.dump(20)
    client, run_id = read(run)
    names = sorted(file.path for file in client.list_artifacts(run_id, "images"))
    maps = [name for name in names if name.startswith("images/eval~room_7~map+step+") and name.endswith(".png")]
    assert [name.split("+")[2] for name in maps] == ["10", "20"]
    assert len(names) == 8
    stored = np.asarray(Files.open(client.download_artifacts(run_id, maps[0], str(tmp_path))))
    np.testing.assert_array_equal(stored, colours)
    grey = next(name for name in names if "grey" in name and name.endswith(".png"))
    assert (np.asarray(Files.open(client.download_artifacts(run_id, grey, str(tmp_path)))) == 128).all()
    with open(client.download_artifacts(run_id, "models/best.bin", str(tmp_path / "..")), "rb") as file:
        assert file.read() == b"first"


def test_figures_are_pictures_too(run):
    from matplotlib.figure import Figure as Drawing

    drawing = Drawing(figsize=(2, 1))
    drawing.add_subplot().plot([0, 1], [1, 0])
    MLflowWriter(run).write({"plot": Figure(drawing, close=False)}, {"plot": ("",)}, 3)
    client, run_id = read(run)
    assert sum(file.path.startswith("images/plot+step+3+") for file in client.list_artifacts(run_id, "images")) == 2


def test_a_value_that_mlflow_cannot_hold_is_named_once(run, caplog):
    writer = MLflowWriter(run)
    for step in (1, 2):
        writer.write({"hist": np.zeros(3)}, {"hist": ("",)}, step)
    told = [record.message for record in caplog.records if "hist" in record.message]
    assert told == ["hist: MLflow takes numbers, texts, pictures and files here, not ndarray"]


def test_what_is_no_number_is_stored_and_said_once(run, caplog):
    writer = MLflowWriter(run)
    for step, value in enumerate([float("nan"), float("inf"), 1.0]):
        writer.write({"train/loss": value}, {"train/loss": ("",)}, step)
    client, run_id = read(run)
    values = [point.value for point in client.get_metric_history(run_id, "train/loss")]
    assert np.isnan(values[0])
    assert values[1] > 1e308
    assert values[2] == 1.0
    assert [record.message for record in caplog.records if "train/loss" in record.message] == [
        f"MLflow run {run_id}: train/loss is nan at step 0"
    ]


def test_a_run_that_vanishes_costs_a_warning_and_its_points_stay_on_disk(run, caplog):
    client, run_id = read(run)
    client.delete_run(run_id)
    MLflowWriter(run).write({"a": 1.0}, {"a": ("",)}, 1)
    with caplog.at_level(logging.WARNING):
        assert not run.close("FINISHED")
    assert f"did not take all of run {run_id}" in caplog.text
    (kept,) = spool_folder().glob("*/journal.jsonl")
    assert '"a",1.0' in kept.read_text().replace(" ", "")


def test_reference_client_refuses_the_names_that_are_made_safe(run):
    client, run_id = read(run)
    with pytest.raises(Exception, match="Names may only contain"):
        client.log_batch(run_id, metrics=[Metric("Train Iter (time)", 1.0, 0, 0)])
