import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

import avp_habitat
from avp_habitat.errors import SceneError, UsageError
from avp_habitat.policies.reactive import HeuristicPolicy, RandomPolicy
from avp_habitat.poses import Intrinsics, project, unproject
from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.sight.rules import candidates
from avp_habitat.simulators.registry import make_simulator
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import MOVE_FORWARD, TURN_LEFT, TURN_RIGHT, TaskSettings
from avp_sb3 import AVPVecEnv

SMALL = {"width": 32, "height": 24}


@pytest.fixture(scope="module")
def env():
    return AVPEnv("builtin:0", **SMALL)


def finish(env, policy, seed=0):
    observation, _ = env.reset(seed=seed)
    infos = []
    while True:
        action, _ = policy.predict(observation)
        observation, _, terminated, truncated, info = env.step(int(action))
        infos.append(info)
        if terminated or truncated:
            return infos


@pytest.mark.filterwarnings("ignore:.*different render modes")
@pytest.mark.parametrize("reward", ["coverage", "proposed"])
def test_gymnasium_and_sb3_accept_the_environment(reward):
    env = AVPEnv("builtin:0", reward=reward, render_mode="rgb_array", **SMALL)
    check_env(env, skip_render_check=True)
    check_env_for_sb3(env)


def test_it_is_registered_by_importing_the_package():
    env = gymnasium.make(avp_habitat.ENV_ID, scene="builtin:0", **SMALL)
    assert isinstance(env.unwrapped, AVPEnv)
    assert env.reset(seed=0)[0].shape == (12,)


def test_equal_seeds_give_equal_episodes_and_others_do_not(env):
    first, again, other = (finish(env, RandomPolicy(3), seed) for seed in (5, 5, 6))
    paths = [infos[-1]["avp_trajectory"].position for infos in (first, again, other)]
    np.testing.assert_array_equal(paths[0], paths[1])
    assert not np.array_equal(paths[0], paths[2])


def test_info_holds_every_part_and_the_last_step_the_episode(env):
    infos = finish(env, RandomPolicy(0))
    assert len(infos) == 80
    parts = {"coverage", "spread", "step", "collision", "redundancy", "stop"}
    assert all(set(info["reward_parts"]) == parts for info in infos)
    assert all("avp_episode" not in info for info in infos[:-1])
    assert infos[-1]["avp_episode"]["views"] == 80
    assert infos[-1]["avp_episode"]["coverage"] == infos[-1]["coverage"]
    coverages = [info["coverage"] for info in infos]
    assert coverages == sorted(coverages)


def test_the_camera_hangs_above_the_floor_under_the_agent(env):
    finish(env, RandomPolicy(1))
    position, _, _ = env.agent_pose
    assert env.camera_to_world[1, 3] == pytest.approx(env.area.floor_height(position[None])[0] + 1.5)
    assert env.area.contains(position[None])[0]


def test_a_visible_floor_point_lands_on_its_pixel_of_the_depth_image(env):
    camera = Intrinsics.from_hfov(640, 480, hfov_deg=90)
    points, checked = env.area.centres, 0
    for pose in heldout_poses(env.simulator, sensor_height_m=1.5, views=6)[:, None]:
        everything = np.ones((1, len(points)), dtype=bool)
        pairs = candidates(pose, camera, points, everything, max_range_m=6.0)
        seen = points[pairs[env.simulator.visible(pose, camera, points, pairs, tolerance_m=0.01), 1]]
        if not len(seen):
            continue
        surface = unproject(env.capture(pose, camera).depth[0], pose[0], camera)
        pixels, _ = project(seen, pose, camera)
        columns, rows = np.floor(pixels[0]).astype(int).T
        back, _ = project(surface[rows, columns], pose, camera)
        assert np.abs(back[0] - pixels[0]).max() <= 0.5 + 1e-3
        # The pixel's surface is the floor there, up to what one pixel spans on the floor at that distance.
        below = np.minimum(rows + 1, camera.height - 1)
        span = np.linalg.norm(surface[below, columns] - surface[rows, columns], axis=1)
        apart = np.linalg.norm(surface[rows, columns] - seen, axis=1)
        assert (apart <= span + 0.02).mean() > 0.95
        checked += len(seen)
    assert checked > 500


def test_the_picture_stands_beside_the_map():
    env = AVPEnv("builtin:0", render_mode="rgb_array", **SMALL)
    env.reset(seed=0)
    before = env.render()
    for _ in range(4):
        env.step(TURN_LEFT)
    after = env.render()
    assert before.shape == after.shape
    assert before.shape[0] == 360
    assert before.shape[1] > 480
    assert (before[:, :480] != after[:, :480]).mean() > 0.3
    assert (before[:, 480:] != after[:, 480:]).any()
    assert AVPEnv("builtin:0", **SMALL).render() is None


def test_the_heuristic_walks_with_room_ahead_and_turns_without():
    depth = np.array([1.01, 0.99, 5.0, 0.2])
    policy = HeuristicPolicy(lambda: depth, seed=0)
    actions = np.array([policy.predict(np.zeros((4, 12)))[0] for _ in range(400)])
    assert set(actions[:, 0]) == set(actions[:, 2]) == {MOVE_FORWARD}
    for column in (1, 3):
        assert set(actions[:, column]) == {TURN_LEFT, TURN_RIGHT}
        assert 0.4 < (actions[:, column] == TURN_LEFT).mean() < 0.6


def test_the_heuristic_uses_the_whole_budget_and_three_actions(env):
    infos = finish(env, HeuristicPolicy.for_env(env, seed=0))
    trajectory = infos[-1]["avp_trajectory"]
    assert len(trajectory.action) == 80
    assert set(trajectory.action) <= {MOVE_FORWARD, TURN_LEFT, TURN_RIGHT}


def test_the_random_policy_uses_all_six_actions_evenly():
    actions, _ = RandomPolicy(0).predict(np.zeros((6000, 12)))
    assert np.abs(np.bincount(actions, minlength=6) / 6000 - 1 / 6).max() < 0.03
    assert RandomPolicy(0).predict(np.zeros(12))[0].shape == ()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rewards": "coverage"}, "unknown AVP-v0 option 'rewards'.*did you mean 'reward'"),
        ({"reward": "coverge"}, "did you mean 'coverage'"),
        ({"simulator": "raycasts"}, "unknown simulator 'raycasts'.*did you mean 'raycast'"),
        ({"render_mode": "human"}, "unknown render_mode 'human'"),
    ],
)
def test_wrong_options_are_named_with_the_nearest_right_one(options, words):
    with pytest.raises(UsageError, match=words):
        AVPEnv("builtin:0", **options)


def test_a_start_can_be_given_and_must_be_navigable(env):
    place = env.area.centres[10]
    env.reset(options={"position": place, "yaw": 0.5})
    position, yaw, _ = env.agent_pose
    np.testing.assert_allclose(position, place, atol=1e-9)
    assert yaw == 0.5
    with pytest.raises(UsageError, match="is not navigable in builtin:0"):
        env.reset(options={"position": [99.0, 99.0]})


def test_steps_outside_of_an_episode_are_refused(env):
    finish(env, RandomPolicy(0))
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    with pytest.raises(UsageError, match="action: expected 0 to 5, got 6"):
        env.step(6)


def test_one_simulator_serves_all_environments_of_a_scene(env):
    assert AVPEnv("builtin:0").simulator is env.simulator
    assert make_simulator("raycast", "builtin:0") is env.simulator


def test_the_batched_environment_equals_separate_ones():
    settings = TaskSettings(width=32, height=24, budget=12, reward="coverage_redundancy")
    batched = AVPVecEnv("builtin:0", agents=3, settings=settings, seed=40)
    separate = DummyVecEnv([lambda: AVPEnv("builtin:0", settings=settings) for _ in range(3)])
    separate.seed(40)
    # SB3 seeds environment i with seed + i, so the starts agree although the generators live elsewhere.
    np.testing.assert_allclose(batched.reset(), separate.reset(), atol=1e-6)
    rng = np.random.default_rng(0)
    for step in range(12):
        actions = rng.integers(6, size=3)
        ours, theirs = batched.step(actions), separate.step(actions)
        np.testing.assert_allclose(ours[1], theirs[1], atol=1e-5)
        np.testing.assert_array_equal(ours[2], theirs[2])
        if step < 11:
            np.testing.assert_allclose(ours[0], theirs[0], atol=1e-6)
    for one, other in zip(ours[3], theirs[3], strict=True):
        assert one["avp_episode"] == pytest.approx(other["avp_episode"])
        np.testing.assert_allclose(one["terminal_observation"], other["terminal_observation"], atol=1e-6)
        assert one["TimeLimit.truncated"] == other["TimeLimit.truncated"]
    assert batched.get_attr("scene_name") == separate.get_attr("scene_name")
    np.testing.assert_allclose(batched.get_attr("centre_depth"), separate.get_attr("centre_depth"), atol=1e-4)


def test_agents_walk_in_their_own_scenes_as_if_alone():
    settings = TaskSettings(width=32, height=24, budget=6, reward="proposed")
    together = AVPVecEnv(["builtin:0", "builtin:3"], agents=4, settings=settings, seed=7)
    alone = [AVPVecEnv(f"builtin:{scene}", agents=1, settings=settings, seed=7 + i) for i, scene in enumerate("0303")]
    np.testing.assert_allclose(together.reset(), np.concatenate([env.reset() for env in alone]), atol=1e-6)
    rng = np.random.default_rng(1)
    for _ in range(6):
        actions = rng.integers(5, size=4)
        ours = together.step(actions)
        theirs = [env.step(actions[i : i + 1]) for i, env in enumerate(alone)]
        np.testing.assert_allclose(ours[0], np.concatenate([step[0] for step in theirs]), atol=1e-6)
        np.testing.assert_allclose(ours[1], np.concatenate([step[1] for step in theirs]), atol=1e-6)
    cells = [len(info["avp_trajectory"].first_seen) for info in ours[3]]
    assert cells == [len(area.centres) for area in together.get_attr("area")]
    assert cells[0] != cells[1]
    assert together.get_attr("scene_name") == ["builtin:0", "builtin:3", "builtin:0", "builtin:3"]
    pose = together.get_attr("camera_to_world")[1]
    camera = Intrinsics.from_hfov(16, 12, hfov_deg=90.0)
    (frames,) = together.env_method("capture", pose[None], camera, indices=1)
    np.testing.assert_array_equal(frames.depth, together.simulators[1].render(pose[None], camera, rgb=False).depth)


@pytest.mark.parametrize(
    ("scenes", "agents", "words"),
    [
        ("builtin:0", 2.5, "agents: expected a whole number from 0 to"),
        ("builtin:0", float("nan"), "agents: expected a whole number from 0 to"),
        (["builtin:0", "builtin:3"], 1, "agents: expected at least 2, one for each scene, got 1"),
        ([], 1, "scene: expected at least one, got none"),
    ],
)
def test_numbers_of_agents_that_cannot_be_are_refused(scenes, agents, words):
    with pytest.raises(UsageError, match=words):
        AVPVecEnv(scenes, agents=agents)


def test_a_broken_scene_in_a_list_is_named_before_training(tmp_path):
    broken = tmp_path / "broken.glb"
    broken.write_bytes(b"not a mesh")
    with pytest.raises(SceneError, match=r"broken\.glb"):
        AVPVecEnv(["builtin:0", str(broken)], agents=4)


def test_sb3_makes_vector_environments_of_the_id():
    env = make_vec_env(avp_habitat.ENV_ID, n_envs=2, env_kwargs={"scene": "builtin:0", **SMALL})
    assert env.reset().shape == (2, 12)
