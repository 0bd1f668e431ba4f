"""A rollout of a few steps through the analytic corridor, written by the suite's own writer."""

from corridor import Corridor

from avp_habitat.poses import Intrinsics
from avp_habitat.rollout import images
from avp_habitat.rollout.drawing import draw_trajectory
from avp_habitat.rollout.writing import RolloutWriter
from avp_habitat.task.env import AVPEnv
from avp_habitat.task.settings import ACTION_NAMES

ACTIONS = (0, 1, 0, 4, 2)


def write_small_rollout(folder, actions=ACTIONS, width=24, height=16):
    """Write a rollout of the given actions, with metrics and map, to a folder."""
    camera = Intrinsics.from_hfov(width, height, hfov_deg=90)
    env = AVPEnv(simulator=Corridor(), budget=len(actions), width=16, height=12)
    env.reset(seed=0)
    with RolloutWriter(folder, camera) as writer:
        for action in actions:
            _, reward, _, _, info = env.step(action)
            frames = env.capture(env.camera_to_world[None], camera)
            writer.add_frame(frames.rgb[0], frames.depth[0], env.camera_to_world)
            place = dict(zip(("x_m", "y_m", "z_m"), env.agent_pose[0], strict=True))
            part = {f"reward_{name}": value for name, value in info["reward_parts"].items()}
            row = {"action": ACTION_NAMES[action], "reward": reward, "coverage": info["coverage"]}
            writer.add_step({**row, **part, **place})
        images.write_rgb(writer.path("trajectory.png"), draw_trajectory(env.area, info["avp_trajectory"]))
        return writer.publish({"policy": {"name": "a list of actions"}, "metrics": info["avp_episode"]})
