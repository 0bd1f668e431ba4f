import json
import os
import signal

import pytest
from nerfstudio_room import write_room
from tracking import mlflow_home

pytest.importorskip("nerfstudio")

import torch
import yaml
from mlflow import MlflowClient
from nerfstudio_training import tiny_config, train
from rrd import entities, rows, verify

from avp_habitat.errors import AVPError
from avp_nerfstudio.data.refusals import CommandError
from avp_nerfstudio.method.trainer import AVPTrainer, AVPTrainerConfig
from avp_nerfstudio.tracking import facts_of, open_run, remembered_id, rollout_folders


@pytest.fixture
def room(tmp_path):
    return write_room(tmp_path / "room")


@pytest.fixture
def store(tmp_path, monkeypatch):
    return MlflowClient(mlflow_home(tmp_path, monkeypatch))


def runs(client, kind="reconstruction"):
    experiments = [experiment.experiment_id for experiment in client.search_experiments()]
    return client.search_runs(experiments, f"tags.avp.kind = '{kind}'")


def tell_origin(room, **facts):
    path = room / "rollout.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | facts))


def signal_in_iteration(monkeypatch, step, number=signal.SIGINT, times=1):
    iterate = AVPTrainer.train_iteration

    def interrupted(self, at):
        if at == step:
            for _ in range(times):
                os.kill(os.getpid(), number)
        return iterate(self, at)

    monkeypatch.setattr(AVPTrainer, "train_iteration", interrupted)


def test_a_training_is_one_finished_run_with_losses_settings_versions_and_its_config(tmp_path, room, store):
    scene = {"name": "a.glb", "sha256": "00ff"}
    tell_origin(room, scene=scene, policy={"name": "oracle"}, seed=3, metrics={"coverage": 0.5, "views": 6.0})
    config = train(tiny_config(room, tmp_path / "out", mlflow="auto"))
    (run,) = runs(store)
    (above,) = runs(store, "rollout")
    assert run.info.status == "FINISHED"
    assert run.info.run_name == "avp-nerfacto e"
    assert run.info.run_id == (config.parent / "mlflow_run_id.txt").read_text().strip()
    assert store.get_experiment(run.info.experiment_id).name == "avp"
    losses = store.get_metric_history(run.info.run_id, "Train Loss")
    assert [metric.step for metric in losses] == [0, 5, 10]
    assert losses[2].value < losses[0].value
    assert [m.step for m in store.get_metric_history(run.info.run_id, "learning_rate/fields")] == [0, 5, 10]
    assert run.data.metrics["Train Iter time"] > 0
    assert run.data.metrics["eval/coverage"] == 0.5
    assert run.data.metrics["eval/views"] == 6
    assert run.data.params["pipeline.model.log2_hashmap_size"] == "8"
    assert run.data.params["optimizers.fields.optimizer.lr"] == "0.02"
    assert run.data.params["rollout.seed"] == "3"
    assert run.data.tags["avp.scene"] == "a.glb"
    assert run.data.tags["avp.scene_digest"] == "00ff"
    assert run.data.tags["avp.policy"] == "oracle"
    assert run.data.tags["avp.rollout"] == str(room)
    assert run.data.tags["version.torch"] == torch.__version__.partition("+")[0]
    assert run.data.tags["avp.rollout_run"] == run.data.tags["mlflow.parentRunId"] == above.info.run_id
    assert run.data.tags["avp.rollout_id"] == above.data.tags["avp.rollout_id"]
    assert "mlflow.parentRunId" not in above.data.tags
    kept = {file.path for file in store.list_artifacts(run.info.run_id)}
    assert kept == {"config.yml", "dataparser_transforms.json"}


def test_the_run_is_below_its_rollout_and_that_below_the_run_that_trained_the_policy(tmp_path, room, store):
    policies = store.create_experiment("policies")
    policy = store.create_run(policies).info.run_id
    store.set_terminated(policy)
    tell_origin(room, mlflow_run_id=policy)
    train(tiny_config(room, tmp_path / "out", mlflow="auto", iterations=2))
    (rollout,) = store.search_runs([policies], f"tags.mlflow.parentRunId = '{policy}'")
    (child,) = store.search_runs([policies], f"tags.mlflow.parentRunId = '{rollout.info.run_id}'")
    assert child.data.tags["avp.policy_run"] == rollout.data.tags["avp.policy_run"] == policy
    assert (child.info.status, rollout.info.status) == ("FINISHED", "FINISHED")


def test_runs_above_in_another_experiment_are_named_without_becoming_the_parent(tmp_path, room, store):
    policies = store.create_experiment("policies")
    policy = store.create_run(policies).info.run_id
    for policy_run, experiment, nested in (("0" * 32, None, True), (policy, "other", False), (policy, None, True)):
        tell_origin(room, mlflow_run_id=policy_run)
        config = tiny_config(room, tmp_path)
        config.pipeline.datamanager.data = room
        opened = open_run(store.tracking_uri, facts_of(config), folder=tmp_path, experiment=experiment)
        opened.close("FINISHED")
        run = store.get_run(opened.run_id)
        rollout = store.get_run(run.data.tags["avp.rollout_run"])
        home = "policies" if policy_run == policy else "avp"
        assert store.get_experiment(rollout.info.experiment_id).name == home
        assert store.get_experiment(run.info.experiment_id).name == (experiment or home)
        assert run.data.tags["avp.policy_run"] == policy_run
        assert (run.data.tags.get("mlflow.parentRunId") == rollout.info.run_id) is nested


def test_a_reconstruction_from_several_rollouts_is_below_their_policy_if_it_is_one(tmp_path, room, store):
    other = write_room(tmp_path / "other")
    policies = [store.create_run(store.create_experiment(name)).info.run_id for name in ("one", "two")]
    config = tiny_config(room, tmp_path)
    parser = config.pipeline.datamanager.dataparser
    parser.data, parser.also = room, (other,)
    for others_policy, parent in ((policies[0], policies[0]), (policies[1], None)):
        tell_origin(room, seed=1, mlflow_run_id=policies[0])
        tell_origin(other, seed=2, mlflow_run_id=others_policy)
        opened = open_run(store.tracking_uri, facts_of(config), folder=tmp_path)
        opened.close("FINISHED")
        tags = store.get_run(opened.run_id).data.tags
        assert tags.get("mlflow.parentRunId") == parent
        rollouts = [store.get_run(run_id) for run_id in tags["avp.rollout_run"].split(", ")]
        assert [run.data.params["rollout.seed"] for run in rollouts] == ["1", "2"]
        assert [run.data.tags["mlflow.parentRunId"] for run in rollouts] == [policies[0], others_policy]
        assert tags["avp.policy_run"] == ", ".join(dict.fromkeys([policies[0], others_policy]))


def test_an_interrupted_training_saves_what_it_learned_and_goes_on_from_there(
    tmp_path, room, store, monkeypatch, capsys
):
    with monkeypatch.context() as patch:
        signal_in_iteration(patch, step=7)
        with pytest.raises(SystemExit) as end:
            train(tiny_config(room, tmp_path / "out", mlflow="auto", iterations=30))
    assert end.value.code == 130
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    folder = tmp_path / "out/e/avp-nerfacto/t"
    (checkpoint,) = (folder / "nerfstudio_models").iterdir()
    assert checkpoint.name == "step-000000007.ckpt"
    (killed,) = runs(store)
    assert killed.info.status == "KILLED"
    assert [m.step for m in store.get_metric_history(killed.info.run_id, "Train Loss")] == [0, 5]
    told = capsys.readouterr().err
    assert f"--load-dir {checkpoint.parent} --data {room} --max-num-iterations 22\n" in told
    config = go_on(room, tmp_path, checkpoint.parent, iterations=22)
    assert [path.name for path in (config.parent / "nerfstudio_models").iterdir()] == ["step-000000029.ckpt"]
    (resumed,) = runs(store)
    assert resumed.info.run_id == killed.info.run_id == remembered_id(config.parent)
    assert resumed.info.status == "FINISHED"
    losses = store.get_metric_history(resumed.info.run_id, "Train Loss")
    assert [metric.step for metric in losses] == [0, 5, 10, 15, 20, 25]
    assert json.loads(resumed.data.tags["avp.changed_params"])["max_num_iterations"] == ["30", "22"]
    # One that is finished is not opened again.
    models = config.parent / "nerfstudio_models"
    another = go_on(room, tmp_path, models, iterations=1, timestamp="another")
    (new,) = (run for run in runs(store) if run.info.run_id != resumed.info.run_id)
    assert remembered_id(another.parent) == new.info.run_id
    assert new.data.tags["avp.continued_from"] == resumed.info.run_id


def go_on(room, folder, checkpoints, *, timestamp="again", **options):
    config = tiny_config(room, folder / "out", mlflow="auto", load_dir=checkpoints, **options)
    config.timestamp = timestamp
    return train(config)


def test_a_second_interruption_ends_at_once_without_a_half_trained_checkpoint(tmp_path, room, monkeypatch, capsys):
    signal_in_iteration(monkeypatch, step=3, number=signal.SIGTERM, times=2)
    with pytest.raises(SystemExit) as end:
        train(tiny_config(room, tmp_path / "out", iterations=30))
    assert end.value.code == 130
    assert not list((tmp_path / "out").rglob("*.ckpt"))
    assert "nothing was saved" in capsys.readouterr().err


def test_a_training_that_breaks_is_a_failed_run(tmp_path, room, store, monkeypatch):
    def breaks(self, step):
        raise ValueError("broken")

    monkeypatch.setattr(AVPTrainer, "train_iteration", breaks)
    with pytest.raises(ValueError, match="broken"):
        train(tiny_config(room, tmp_path / "out", mlflow="auto"))
    assert [run.info.status for run in runs(store)] == ["FAILED"]


def test_a_recording_shows_losses_and_cameras(tmp_path, room):
    path = tmp_path / "r" / "training.rrd"
    train(tiny_config(room, tmp_path / "out", rerun=path))
    verify(path)
    found = entities(path)
    assert len([name for name in found if name.startswith("/world/training/")]) == 6
    assert len([name for name in found if name.startswith("/world/heldout/")]) == 2
    losses = rows(path, "/plots/Train\\ Loss", "Scalars:scalars")
    assert [step for step, _ in losses] == [0, 5, 10]


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_device_that_is_not_there_is_refused_and_leaves_nothing(tmp_path, room):
    config = tiny_config(room, tmp_path / "out")
    config.machine.device_type, config.timestamp = "cuda", "{timestamp}"
    with pytest.raises(
        CommandError, match=r"is to train on a GPU, and none was found .* `ns-train avp-nerfacto --data"
    ):
        train(config)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"mlflow": "nonsense://me:secret@host"}, "MLflow at nonsense://host cannot be used"),
        ({"rerun": "room/rollout.json"}, "rollout.json: exists already"),
        ({"load_dir": "room"}, r"room: expected a checkpoint \(step-\*.ckpt\), found none"),
        ({"load_checkpoint": "room/step-000000001.ckpt"}, "could not load it: Checkpoint .* does not exist"),
        ({"load_checkpoint": "room/rollout.json"}, "rollout.json: expected a checkpoint of this method"),
    ],
)
def test_what_cannot_be_used_ends_the_training_with_one_line(tmp_path, room, options, text):
    options = {key: tmp_path / value if key != "mlflow" else value for key, value in options.items()}
    with pytest.raises(CommandError, match=text) as error:
        train(tiny_config(room, tmp_path / "out", **options))
    assert isinstance(error.value, SystemExit)
    assert isinstance(error.value, AVPError)
    assert error.value.code == f"error: {error.value}"
    assert "\n" not in str(error.value)


def test_the_settings_survive_config_yml(tmp_path):
    config = tiny_config(tmp_path, tmp_path, rerun=tmp_path / "a.rrd")
    read = yaml.load(yaml.dump(config), Loader=yaml.Loader)
    assert isinstance(read, AVPTrainerConfig)
    assert read == config


def test_data_that_is_no_rollout_has_no_origin(tmp_path, room):
    config = tiny_config(room, tmp_path)
    config.pipeline.datamanager.data = room / "rollout.json"
    assert rollout_folders(config) == [room]
    config.pipeline.datamanager.data = tmp_path
    assert rollout_folders(config) == []
    assert facts_of(config).tags["avp.method"] == "avp-nerfacto"


def test_figures_of_rollouts_are_not_taken_for_those_of_a_part_or_of_several(tmp_path, room):
    other = write_room(tmp_path / "other")
    config = tiny_config(room, tmp_path)
    parser = config.pipeline.datamanager.dataparser
    parser.data = room
    for folder, policy_run in ((room, "1" * 32), (other, "2" * 32)):
        origin = {"scene": {"name": "a.glb"}, "policy": {"name": "oracle"}, "seed": 3}
        tell_origin(folder, metrics={"coverage": 0.5}, mlflow_run_id=policy_run, **origin)
    assert facts_of(config).metrics == {"eval/coverage": 0.5}
    assert facts_of(config).policy_runs == ("1" * 32,)
    config.experiment_name = None
    assert facts_of(config).name == "avp-nerfacto oracle a.glb seed 3"
    config.experiment_name = "mine"
    assert facts_of(config).name == "avp-nerfacto mine"
    parser.max_views = 3
    assert facts_of(config).metrics == {"rollout/coverage": 0.5}
    parser.max_views, parser.also = 0, (other,)
    facts = facts_of(config)
    assert facts.metrics == {"rollout/coverage": 0.5}
    assert facts.tags["avp.rollout"] == f"{room}, {other}"
    assert facts.tags["avp.policy_run"] == f"{'1' * 32}, {'2' * 32}"
    assert facts.policy_runs == ("1" * 32, "2" * 32)
