import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mlflow import MlflowClient
from mlflow.entities import Metric
from mlflow.utils.validation import _validate_metric_name, _validate_param_name, _validate_tag_name
from stable_baselines3.common.logger import Logger
from tracking import mlflow_home

from avp_sb3.mlflow_writer import MLflowWriter, safe_name


@given(st.text(max_size=400))
def test_any_name_becomes_one_that_mlflow_takes(name):
    for validate in (_validate_metric_name, _validate_param_name, _validate_tag_name):
        validate(safe_name(name))


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("rollout/ep_rew_mean", "rollout/ep_rew_mean"),
        ("Train Iter (time)", "Train Iter _time_"),
        ("a//b/../c/", "a/b/c"),
        ("reward[0]:x", "reward_0__x"),
        ("", "_"),
    ],
)
def test_names_keep_what_they_can(name, safe):
    assert safe_name(name) == safe


@pytest.fixture
def run(tmp_path, monkeypatch):
    client = MlflowClient(mlflow_home(tmp_path, monkeypatch))
    return client, client.create_run("0").info.run_id


def test_what_the_logger_dumps_is_stored_by_step(run):
    client, run_id = run
    writer = MLflowWriter(client, run_id)
    logger = Logger(None, [writer])
    for step in (10, 20):
        logger.record("train/loss (mean)", step / 4)
        logger.record("train/float32", np.float32(0.5))
        logger.record("train/tensor", torch.tensor(3))
        logger.record("host/name", "a text")
        logger.record("time/secret", 1.0, exclude=("stdout", "mlflow"))
        logger.dump(step)
    writer.flush()
    history = client.get_metric_history(run_id, "train/loss _mean_")
    assert [(point.step, point.value) for point in history] == [(10, 2.5), (20, 5.0)]
    data = client.get_run(run_id).data
    assert data.metrics.keys() == {"train/loss _mean_", "train/float32", "train/tensor"}
    assert (data.metrics["train/float32"], data.metrics["train/tensor"]) == (0.5, 3.0)
    assert data.tags["host/name"] == "a text"


def test_a_value_that_mlflow_cannot_hold_is_named_once(run):
    writer = MLflowWriter(*run)
    with pytest.warns(UserWarning, match="hist: MLflow takes numbers and texts here, not ndarray"):
        writer.write({"hist": np.zeros(3)}, {"hist": ("",)}, 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        writer.write({"hist": np.zeros(3)}, {"hist": ("",)}, 1)


def test_a_run_that_vanishes_costs_a_warning_not_the_training(run):
    client, run_id = run
    writer = MLflowWriter(client, run_id)
    client.delete_run(run_id)
    writer.write({"a": 1.0}, {"a": ("",)}, 1)
    with pytest.warns(UserWarning, match=f"MLflow run {run_id}: some metrics were not stored"):
        writer.flush()


def test_reference_client_refuses_the_names_that_are_made_safe(run):
    client, run_id = run
    with pytest.raises(Exception, match="Names may only contain"):
        client.log_batch(run_id, metrics=[Metric("Train Iter (time)", 1.0, 0, 0)])
