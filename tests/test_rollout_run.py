import hashlib
import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from mlflow import MlflowClient
from tracking import mlflow_home, ppo
from tracking_server import free_port

from avp_habitat import collect as collecting
from avp_habitat import command
from avp_habitat.errors import RolloutError
from avp_habitat.tracking import deliver
from avp_habitat.tracking import rollout_run as module
from avp_habitat.tracking.rollout_run import figures, rollout_id, rollout_run
from avp_habitat.tracking.run import NewRun, start_run
from avp_habitat.tracking.stores import TrackingError

SMALL = ["--budget", "4", "--width", "32", "--height", "24"]


@pytest.fixture(scope="module")
def collected(tmp_path_factory):
    """A rollout of a baseline; tests take copies."""
    folder = tmp_path_factory.mktemp("collected") / "r0"
    assert collect("--policy", "random", "--out", folder, "--mlflow", "off") == 0
    return folder


@pytest.fixture
def rollout(collected, tmp_path):
    return shutil.copytree(collected, tmp_path / "r0")


@pytest.fixture
def store(tmp_path, monkeypatch):
    return MlflowClient(mlflow_home(tmp_path, monkeypatch))


def collect(*words):
    return command.run(collecting.main, [str(word) for word in ("--scene", "builtin:0", *SMALL, *words)])


def log(*words):
    return command.run(module.main, [str(word) for word in words])


def runs(client, query=""):
    return client.search_runs([experiment.experiment_id for experiment in client.search_experiments()], query)


def tell(rollout, **facts):
    path = rollout / "rollout.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | facts))


def policy_run(client, experiment="policies"):
    run = client.create_run(client.create_experiment(experiment))
    client.set_terminated(run.info.run_id)
    return run.info.run_id


def test_a_rollout_is_a_finished_run_with_its_figures_settings_origin_and_files(rollout, store):
    run = store.get_run(rollout_run(store, rollout))
    meta = json.loads((rollout / "rollout.json").read_text())
    assert (run.info.status, run.info.run_name) == ("FINISHED", f"rollout random builtin:0 seed {meta['seed']}")
    assert store.get_experiment(run.info.experiment_id).name == "avp"
    written = {f"eval/{name}": value for name, value in meta["metrics"].items()}
    cpv = 100 * meta["metrics"]["coverage"] / 4
    assert run.data.metrics == pytest.approx(written | {"eval/cpv": cpv})
    assert run.data.metrics["eval/views"] == 4
    assert run.data.params["rollout.budget"] == "4"
    assert run.data.params["rollout.created"] == meta["created"]
    tags = run.data.tags
    assert tags["avp.kind"] == "rollout"
    assert tags["avp.policy"] == "random"
    assert (tags["avp.scene"], tags["avp.scene_digest"]) == ("builtin:0", meta["scene"]["sha256"])
    assert tags["avp.rollout"] == str(rollout)
    assert tags["version.numpy"] == meta["versions"]["numpy"]
    assert "mlflow.parentRunId" not in tags
    parts = [hashlib.sha256((rollout / name).read_bytes()).digest() for name in ("rollout.json", "steps.csv")]
    assert tags["avp.rollout_id"] == hashlib.sha256(b"".join(parts)).hexdigest()
    files = {file.path: file.file_size for file in store.list_artifacts(run.info.run_id)}
    assert files == {name: (rollout / name).stat().st_size for name in ("rollout.json", "steps.csv", "trajectory.png")}


def test_a_copy_elsewhere_is_the_same_rollout_and_another_episode_is_not(rollout, store, tmp_path):
    first = rollout_run(store, rollout)
    copy = shutil.copytree(rollout, tmp_path / "elsewhere")
    assert rollout_run(store, copy, experiment="another") == first
    assert rollout_run(str(store.tracking_uri), copy / "rollout.json") == first
    tell(copy, seed=5)
    assert rollout_run(store, copy) != first
    assert len(runs(store)) == 2
    assert len(store.get_metric_history(first, "eval/coverage")) == 1


def test_the_run_is_a_child_of_the_run_that_trained_the_policy_in_its_experiment(rollout, store):
    policy = policy_run(store)
    tell(rollout, mlflow_run_id=policy, policy={"name": "model.zip"}, reward="coverage", seed=7)
    run = store.get_run(rollout_run(store, rollout, experiment="ignored"))
    assert run.info.experiment_id == store.get_run(policy).info.experiment_id
    assert run.data.tags["mlflow.parentRunId"] == run.data.tags["avp.policy_run"] == policy
    assert run.info.run_name == "rollout model.zip coverage builtin:0 seed 7"


def test_without_a_policys_run_mlflows_variable_names_the_experiment(rollout, store, monkeypatch):
    monkeypatch.setenv("MLFLOW_EXPERIMENT_NAME", "mine")
    run = store.get_run(rollout_run(store, rollout))
    assert store.get_experiment(run.info.experiment_id).name == "mine"


def test_a_deleted_experiment_is_named_before_a_run_is_made(rollout, store):
    store.delete_experiment(store.create_experiment("gone"))
    with pytest.raises(TrackingError, match=r"MLflow experiment 'gone' at .* is deleted; .*mlflow experiments restore"):
        rollout_run(store, rollout, experiment="gone")


def test_a_policy_run_that_the_store_does_not_have_is_named_only(rollout, store):
    tell(rollout, mlflow_run_id="0" * 32)
    run = store.get_run(rollout_run(store, rollout, experiment="mine"))
    assert store.get_experiment(run.info.experiment_id).name == "mine"
    assert run.data.tags["avp.policy_run"] == "0" * 32
    assert "mlflow.parentRunId" not in run.data.tags


def test_a_parent_that_was_kept_offline_is_tied_when_it_is_there(rollout, store):
    policy = start_run(f"http://127.0.0.1:{free_port()}", NewRun(), offline=True)
    tell(rollout, mlflow_run_id=policy.run_id)
    assert not policy.close("FINISHED", timeout_s=0.1)
    first = rollout_run(store, rollout)
    assert "mlflow.parentRunId" not in store.get_run(first).data.tags
    assert command.run(deliver.main, ["--mlflow", store.tracking_uri]) == 0
    assert rollout_run(store, rollout) == first
    (above,) = runs(store, "tags.avp.key != ''")
    tags = store.get_run(first).data.tags
    assert tags["mlflow.parentRunId"] == tags["avp.policy_run"] == above.info.run_id


def test_what_a_killed_program_left_open_is_finished_without_doubling_it(rollout, store, monkeypatch):
    class KilledError(OSError):
        pass

    def killed(*_):
        raise KilledError

    with monkeypatch.context() as patch:
        patch.setattr(MlflowClient, "log_artifact", killed)
        with pytest.raises(TrackingError, match=f"did not take the rollout {rollout}"):
            rollout_run(store, rollout)
    (left,) = runs(store)
    assert left.info.status == "RUNNING"
    assert rollout_run(store, rollout) == left.info.run_id
    assert store.get_run(left.info.run_id).info.status == "FINISHED"
    assert len(store.get_metric_history(left.info.run_id, "eval/views")) == 1
    assert len(store.list_artifacts(left.info.run_id)) == 3


def test_threads_that_log_a_rollout_and_its_copy_at_once_agree_on_one_run(rollout, store, tmp_path):
    copy = shutil.copytree(rollout, tmp_path / "copy")
    with ThreadPoolExecutor(4) as pool:
        told = list(pool.map(lambda folder: rollout_run(store.tracking_uri, folder), [rollout, copy, rollout, copy]))
    (run,) = runs(store)
    assert set(told) == {run.info.run_id}
    assert run.info.status == "FINISHED"
    assert len(store.get_metric_history(run.info.run_id, "eval/views")) == 1


@pytest.mark.slow
def test_programs_that_log_a_rollout_at_once_agree_on_one_run(rollout, store, tmp_path):
    copy = shutil.copytree(rollout, tmp_path / "copy")
    lines = [[sys.executable, "-m", "avp_habitat.tracking.rollout_run", folder] for folder in (rollout, rollout, copy)]
    processes = [subprocess.Popen(line, stdout=subprocess.PIPE, text=True, cwd=tmp_path) for line in lines]
    told = [process.communicate(timeout=300)[0].splitlines()[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0]
    assert len({line.rpartition(" ")[2] for line in told}) == 1
    (run,) = runs(store)
    assert run.info.status == "FINISHED"
    assert run.info.run_id in told[0]
    assert len(store.get_metric_history(run.info.run_id, "eval/views")) == 1


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        ("rollout.json", "{", "expected JSON, could not read it"),
        ("rollout.json", None, "expected this file of the rollout, found none"),
        ("rollout.json", '{"format": "other"}', "expected format 'avp-rollout', found 'other'"),
        ("rollout.json", {"mlflow_run_id": 5}, "expected mlflow_run_id to be a text or null, found 5"),
        ("steps.csv", None, "expected this file of the rollout: No such file"),
    ],
)
def test_a_damaged_rollout_is_named_and_not_logged(rollout, store, name, text, fault, capsys):
    if isinstance(text, dict):
        tell(rollout, **text)
    else:
        (rollout / name).unlink() if text is None else (rollout / name).write_text(text)
    with pytest.raises(RolloutError) as error:
        rollout_run(store, rollout)
    assert str(error.value).startswith(f"{rollout / name}: {fault}")
    assert log(rollout) == 1
    assert capsys.readouterr().err == f"error: {error.value}\n"
    assert runs(store) == []


def test_coverage_per_view_is_added_to_the_figures():
    metrics = {"coverage": 0.5, "views": 8.0}
    assert figures({"metrics": metrics}) == {"eval/coverage": 0.5, "eval/views": 8.0, "eval/cpv": 6.25}
    assert figures({"metrics": {"coverage": 0.5, "views": 0}}, "rollout") == {
        "rollout/coverage": 0.5,
        "rollout/views": 0,
    }
    assert figures({}) == {}


def test_a_collected_rollout_is_logged_where_the_environment_says(store, tmp_path, capsys):
    assert collect("--policy", "random", "--out", tmp_path / "r", "--experiment", "mine") == 0
    (run,) = runs(store)
    assert store.get_experiment(run.info.experiment_id).name == "mine"
    told = capsys.readouterr().out
    assert f"MLflow:   run {run.info.run_id}\ncompare:  mlflow ui --backend-store-uri {store.tracking_uri}" in told
    assert run.data.tags["avp.rollout_id"] == rollout_id(tmp_path / "r")


def test_collecting_needs_no_store_and_the_rollout_is_logged_later(store, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"http://me:secret@127.0.0.1:{free_port()}")
    assert collect("--policy", "random", "--out", tmp_path / "r") == 0
    assert (tmp_path / "r/rollout.json").is_file()
    warning = capsys.readouterr().err.strip().splitlines()[-1]
    assert warning.startswith("warning: MLflow at http://127.0.0.1:")
    assert "no server answers there" in warning
    assert warning.endswith(f"log it later: python -m avp_habitat.tracking.rollout_run {tmp_path / 'r'}")
    monkeypatch.setenv("MLFLOW_TRACKING_URI", store.tracking_uri)
    assert log(tmp_path / "r", "--experiment", "mine") == 0
    (run,) = runs(store)
    assert f"{tmp_path / 'r'}: MLflow run {run.info.run_id}\n" in capsys.readouterr().out
    assert store.get_experiment(run.info.experiment_id).name == "mine"


@pytest.mark.parametrize("offline", ["", "1"])
def test_a_mistyped_address_is_told_before_anything_is_collected(tmp_path, monkeypatch, capsys, offline):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("AVP_MLFLOW_OFFLINE", offline)
    assert collect("--policy", "random", "--out", "r", "--mlflow", "nonsense://me:secret@host") == 1
    assert "error: MLflow at nonsense://host cannot be used" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_named_server_that_does_not_answer_stops_the_collection_unless_it_is_offline(tmp_path, monkeypatch, capsys):
    address = f"127.0.0.1:{free_port()}"
    monkeypatch.chdir(tmp_path)
    words = ["--policy", "random", "--out", "r", "--mlflow", f"http://me:secret@{address}", "--experiment", "a b"]
    assert collect(*words) == 1
    told = capsys.readouterr().err
    assert told.startswith(f"error: MLflow at http://{address} cannot be used: no server answers there")
    assert told.endswith("AVP_MLFLOW_OFFLINE=1\n")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setenv("AVP_MLFLOW_OFFLINE", "1")
    assert collect(*words) == 0
    warning = capsys.readouterr().err.strip().splitlines()[-1]
    later = f"python -m avp_habitat.tracking.rollout_run r --mlflow http://{address} --experiment 'a b'"
    assert warning.endswith(f"log it later: {later}")


def test_logging_nowhere_is_refused(rollout, capsys):
    assert log(rollout, "--mlflow", "off") == 2
    assert "--mlflow: expected an address or auto, got off" in capsys.readouterr().err


def test_importing_the_module_imports_no_mlflow():
    code = "import sys, avp_habitat.collect, avp_habitat.tracking.rollout_run; print('mlflow' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "False\n"


@pytest.mark.slow  # trains a policy and a reconstruction
def test_training_rollout_and_reconstruction_are_nested_in_one_experiment(store, tmp_path, capsys):
    pytest.importorskip("nerfstudio")
    import nerfstudio.scripts.train  # noqa: F401  before the modules that use it, which import it in circles
    from nerfstudio_training import tiny_config, train

    import avp_nerfstudio.log
    from avp_sb3 import MLflowCallback

    callback = MLflowCallback("mine", "a training")
    model = ppo()
    model.learn(64, callback=callback)
    model.save(tmp_path / "model.zip")
    assert collect("--policy", tmp_path / "model.zip", "--out", tmp_path / "r") == 0
    config = train(tiny_config(tmp_path / "r", tmp_path / "out", mlflow="auto", iterations=12))
    assert command.run(avp_nerfstudio.log.main, [str(config), "--pictures", "1"]) == 0

    training = store.get_run(callback.run_id)
    (rollout,) = runs(store, "tags.avp.kind = 'rollout'")
    (reconstruction,) = runs(store, "tags.avp.kind = 'reconstruction'")
    family = [training, rollout, reconstruction]
    ids = [run.info.run_id for run in family]
    assert [run.data.tags.get("mlflow.parentRunId") for run in family] == [None, *ids[:2]]
    assert {store.get_experiment(run.info.experiment_id).name for run in family} == {"mine"}
    assert {run.info.status for run in family} == {"FINISHED"}
    tags = reconstruction.data.tags
    assert (tags["avp.policy_run"], tags["avp.rollout_run"]) == (ids[0], ids[1])
    assert (tags["avp.policy"], tags["avp.method"]) == ("model.zip", "avp-nerfacto")
    assert tags["avp.scene"] == rollout.data.tags["avp.scene"] == "builtin:0"
    assert tags["avp.rollout_id"] == rollout.data.tags["avp.rollout_id"] == rollout_id(tmp_path / "r")
    for name in ("eval/coverage", "eval/views", "eval/annd_m", "eval/ei", "eval/cpv"):
        assert reconstruction.data.metrics[name] == rollout.data.metrics[name]
    assert {"eval/psnr", "eval/ssim", "Train Loss"} <= reconstruction.data.metrics.keys()
    assert {"heldout", "config.yml"} <= {file.path for file in store.list_artifacts(ids[2])}
    assert f"compare:  mlflow ui --backend-store-uri {store.tracking_uri}" in capsys.readouterr().out
