import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from mlflow import MlflowClient
from rrd import verify
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor
from tracking import mlflow_home

from avp_habitat.errors import SceneError, SimulatorError, UsageError
from avp_habitat.policies.frontier import FrontierPolicy
from avp_habitat.policies.reactive import HeuristicPolicy
from avp_habitat.poses import Intrinsics
from avp_habitat.task.agent_view import agent_views
from avp_habitat.task.settings import TaskSettings
from avp_sb3 import AVPSubprocVecEnv, AVPVecEnv, EvaluationCallback, MetricsCallback, MLflowCallback, RerunCallback
from avp_sb3.evaluation.batch import run_batch

SETTINGS = TaskSettings(width=16, height=12, budget=6)
ROOMS = ["builtin:0", "builtin:1"]


@pytest.fixture
def make():
    """Environments in processes that end with the test."""
    opened = []

    def _make(scene=ROOMS, cls=AVPSubprocVecEnv, **options):
        opened.append(cls(scene, **{"settings": SETTINGS, "seed": 3, **options}))
        return opened[-1]

    yield _make
    for env in opened:
        env.close()


@pytest.fixture(scope="module")
def five():
    """Five agents over four workers in two rooms, for tests that leave them running."""
    env = AVPSubprocVecEnv(ROOMS, agents=5, workers=4, settings=SETTINGS, seed=3)
    yield env
    env.close()


def children():
    """Process ids of all descendants of this process."""
    found = subprocess.run(["ps", "-eo", "pid=,ppid=,args="], capture_output=True, text=True, check=True).stdout
    rows = [line.split(None, 2) for line in found.splitlines()]
    family, grown = {str(os.getpid())}, True
    while grown:
        more = {pid for pid, parent, _ in rows if parent in family} - family
        family, grown = family | more, bool(more)
    return {int(pid) for pid, _, words in rows if pid in family and not words.startswith("ps -eo")} - {os.getpid()}


def test_agents_see_and_get_what_they_do_in_one_process(five):
    one = AVPVecEnv(ROOMS, agents=5, settings=SETTINGS)
    rng = np.random.default_rng(0)
    five.seed(11)
    one.seed(11)
    np.testing.assert_array_equal(five.reset(), one.reset())
    for _ in range(14):
        actions = rng.integers(6, size=5)
        (*arrays, infos), (*expected, expected_infos) = five.step(actions), one.step(actions)
        for found, other in zip(arrays, expected, strict=True):
            assert found.dtype == other.dtype
            np.testing.assert_array_equal(found, other)
        for info, other in zip(infos, expected_infos, strict=True):
            assert (info["coverage"], info["reward_parts"]) == (other["coverage"], other["reward_parts"])
            assert info.keys() == other.keys()
    for name in ("scene_name", "scene_digest", "settings", "centre_depth"):
        assert five.get_attr(name, [4, 1, 0]) == one.get_attr(name, [4, 1, 0])


def test_a_look_around_happens_in_the_agents_own_scene(five):
    one = AVPVecEnv(ROOMS, agents=5, settings=SETTINGS)
    poses = np.stack([np.eye(4)] * 2)
    poses[:, :3, 3] = five.get_attr("area", 1)[0].centres[40] + [0, 1.5, 0]
    camera = Intrinsics.from_hfov(8, 6, hfov_deg=90.0)
    (found,) = five.env_method("capture", poses, camera, indices=3)
    np.testing.assert_array_equal(found.rgb, one.capture(3, poses, camera).rgb)
    assert not np.array_equal(found.rgb, one.capture(2, poses, camera).rgb)


def test_baselines_act_in_processes_as_in_one(five):
    one = AVPVecEnv(ROOMS, agents=5, settings=SETTINGS)
    for planner in (FrontierPolicy, HeuristicPolicy):
        walks = []
        for env in (five, one):
            env.seed(5)
            policy, observation, walk = planner.for_env(env, 0), env.reset(), []
            for _ in range(5):
                observation, *_ = env.step(policy.predict(observation)[0])
                walk.append(observation)
            walks.append(np.stack(walk))
        np.testing.assert_array_equal(*walks)
    with pytest.raises(SimulatorError, match="builtin:1: its simulator is in another process"):
        agent_views(five)[1].simulator.visible()


def test_what_an_agent_does_not_have_is_named_and_the_workers_go_on(five):
    with pytest.raises(UsageError, match="simulator stays in its process; ask for area, scene_name or agent_view"):
        five.get_attr("simulator")
    with pytest.raises(UsageError, match=r"AVPSubprocVecEnv: budget cannot be set"):
        five.set_attr("budget", 3)
    with pytest.raises(AttributeError, match="nothing"):
        five.get_attr("nothing")
    assert not five.has_attr("nothing")
    assert five.has_attr("agent_view")
    five.reset()


def test_an_interrupted_step_leaves_no_answer_that_a_later_question_would_get(five):
    five.reset()
    five.step_async(np.zeros(5, dtype=np.int64))  # Ctrl-C comes here: nobody waits for the answers.
    assert five.env_method("has_attr", "area") == [True] * 5


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_killed_worker_is_one_error_with_its_scene_and_none_is_left(make, number):
    env = make()
    env.reset()
    os.kill(env.processes[1].pid, number)
    with pytest.raises(SimulatorError, match=rf"worker 1 of 2 \(scene builtin:1\) was killed by {number.name}"):
        env.step(np.zeros(2, dtype=np.int64))
    assert [process.exitcode for process in env.processes] == [0, -number]
    with pytest.raises(SimulatorError, match="its workers were ended; make a new one"):
        env.reset()


def test_a_worker_that_leaves_by_itself_is_told_with_its_exit_code(make):
    env = make()
    with pytest.raises(SimulatorError, match=r"worker 1 of 2 \(scene builtin:1\) ended with exit code 1; what it said"):
        env.get_attr("_task", 1)  # It cannot be sent.


def test_a_scene_that_cannot_be_opened_is_the_parents_error_and_ends_all_workers():
    before = children()
    with pytest.raises(SceneError, match=r"gone\.glb: no such scene file.*\[worker 1 of 2 \(scene gone\.glb\)\]"):
        AVPSubprocVecEnv(["builtin:0", "gone.glb"], settings=SETTINGS)
    time.sleep(0.2)
    assert len(children() - before) <= 2, "at most the fork server and the resource tracker of multiprocessing"


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"scene": []}, "scene: expected at least one, got none"),
        ({"workers": 3}, "workers: expected a multiple of the number of scenes, 2, got 3"),
        ({"agents": 1}, "agents: expected at least 2, one for each worker, got 1"),
        ({"simulator": "habitt"}, "unknown simulator 'habitt'.*did you mean 'habitat'"),
        ({"gpu": 0}, "gpu: is of the simulator 'habitat', but 'raycast' was chosen"),
        ({"simulator": "habitat", "gpu": [0, -2]}, "gpu: expected a CUDA device from 0, or -1 for none, got -2"),
        (
            {"simulator": "habitat", "navmesh": "a.navmesh"},
            r"navmesh: a\.navmesh is of one scene, got 2: builtin:0, bu",
        ),
        ({"start_method": "fork"}, "start_method: expected one of forkserver, spawn, got 'fork'"),
    ],
)
def test_wrong_arguments_end_before_a_process_is_started(options, error):
    before = children()
    with pytest.raises(UsageError, match=error):
        AVPSubprocVecEnv(**{"scene": ROOMS, **options})
    assert children() <= before


def test_evaluations_are_the_same_in_processes_as_in_one(make):
    model = PPO(
        "MlpPolicy", AVPVecEnv(ROOMS, agents=2, settings=SETTINGS), n_steps=8, batch_size=16, seed=0, device="cpu"
    )
    one, several = AVPVecEnv(ROOMS, agents=6, settings=SETTINGS), make(agents=6)
    for seed in (50, 7):
        found, expected = (run_batch(model, env, 3, seed=seed, deterministic=True) for env in (several, one))
        assert found.keys() == expected.keys()
        for scene in found:
            for episode, other in zip(found[scene], expected[scene], strict=True):
                assert episode.figures == other.figures


@pytest.mark.slow
def test_all_callbacks_work_with_processes(make, tmp_path, monkeypatch):
    client = MlflowClient(mlflow_home(tmp_path, monkeypatch))
    env = VecMonitor(make(agents=4, workers=2))
    model = PPO("MlpPolicy", env, n_steps=32, batch_size=64, n_epochs=1, seed=0, device="cpu")
    tracker = MLflowCallback()
    evaluation = EvaluationCallback("builtin:2", every=128, episodes=2, best_model=tmp_path / "best.zip")
    recording = RerunCallback(tmp_path / "run.rrd")
    model.learn(256, callback=[evaluation, MetricsCallback(), tracker, recording])
    run = client.get_run(tracker.run_id)
    assert {"avp/coverage", "rollout/ep_rew_mean", "eval/coverage"} <= run.data.metrics.keys()
    assert run.data.tags["avp.scene"] == "builtin:0, builtin:1"
    assert {"model.zip", "trajectory.png"} <= {file.path for file in client.list_artifacts(tracker.run_id)}
    verify(tmp_path / "run.rrd")


SCRIPT = """
import sys, time
import numpy as np
from avp_habitat import command
from avp_habitat.task.settings import TaskSettings
from avp_sb3 import AVPSubprocVecEnv

def main(argv):
    env = AVPSubprocVecEnv(["builtin:0", *(argv or ["builtin:1"])], settings=TaskSettings(width=16, height=12), seed=0)
    env.reset()
    print(*[process.pid for process in env.processes], flush=True)
    if argv:
        return
    while True:
        env.step(np.zeros(2, dtype=np.int64))

if __name__ == "__main__":
    sys.exit(command.run(main))
"""


@pytest.fixture
def script(tmp_path):
    path = tmp_path / "train.py"
    path.write_text(SCRIPT)
    return [sys.executable, str(path)]


def alive(pids):
    return [pid for pid in pids if Path(f"/proc/{pid}").exists() and "Z" not in state(pid)]


def state(pid):
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_an_interrupted_program_leaves_no_process_and_no_traceback(script, number):
    program = subprocess.Popen(
        script, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    workers = [int(word) for word in program.stdout.readline().split()]
    assert len(alive(workers)) == 2
    time.sleep(0.3)
    # Ctrl-C reaches all processes of the terminal.
    (os.killpg if number == signal.SIGINT else os.kill)(program.pid, number)
    _, err = program.communicate(timeout=60)
    assert program.returncode == (-number if number == signal.SIGKILL else 130)
    # Who is killed has no time to read the workers' last answers, which they then say.
    assert number == signal.SIGKILL or "Traceback" not in err, err
    until = time.monotonic() + 20
    while alive(workers) and time.monotonic() < until:
        time.sleep(0.1)
    assert not alive(workers)


@pytest.mark.slow
def test_a_program_that_never_closes_ends_its_workers(script):
    done = subprocess.run([*script, "builtin:2"], capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert not alive(map(int, done.stdout.split()))
    done = subprocess.run([*script, "gone.glb"], capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert done.stderr.startswith("error: gone.glb: no such scene file")


@pytest.mark.slow
def test_a_killed_worker_of_a_program_is_one_line(script):
    program = subprocess.Popen(script, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    first, second = map(int, program.stdout.readline().split())
    os.kill(second, signal.SIGKILL)
    _, err = program.communicate(timeout=60)
    assert program.returncode == 1
    assert err.splitlines() == [
        "error: worker 1 of 2 (scene builtin:1) was killed by SIGKILL (by somebody, or by the system for want of "
        "memory); the other workers were ended"
    ]
    assert not alive([first])


@pytest.mark.slow
def test_a_program_without_the_guard_is_told_to_have_one(tmp_path):
    path = tmp_path / "unguarded.py"
    path.write_text("from avp_sb3 import AVPSubprocVecEnv\nAVPSubprocVecEnv('builtin:0')\n")
    done = subprocess.run([sys.executable, str(path)], capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 1
    assert 'if __name__ == "__main__":' in done.stderr.splitlines()[-1]
