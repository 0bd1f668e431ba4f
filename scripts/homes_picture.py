"""Make the pages' picture of a generated home: its plan, seen from above without ceilings, and four views."""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from avp_habitat.poses import Intrinsics, camera_to_world
from avp_habitat.scenes.loader import Scene, load_scene
from avp_habitat.scenes.mesh import TexturedMesh, only
from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.simulators.raycast import RaycastSimulator

TILE = (360, 270)
GAP = 4
CUT_M = 2.3
"""Height from which on walls, lamps and ceilings are left out."""
FROM_M = 80.0
"""Height of the eye that sees the plan, so far away that walls hardly lean."""


LEVEL = (-0.12, 0.45)
"""Sines of the least and greatest pitch of a view, positive downwards."""


def seen(simulator: RaycastSimulator, poses: np.ndarray, camera: Intrinsics, size: tuple[int, int]) -> Image.Image:
    """The first of the poses, rendered larger and reduced."""
    picture = simulator.render(poses[:1], camera, rgb=True).rgb
    assert picture is not None
    return Image.fromarray(picture[0]).resize(size, Image.Resampling.LANCZOS)


def plan(mesh: TexturedMesh, size: tuple[int, int]) -> Image.Image:
    """The home from above, in the middle of a picture of that size."""
    low, high = mesh.bounds
    heights = mesh.vertices[mesh.triangles][:, :, 1]
    middle, pixels = (low + high) / 2, np.array(size) * 2
    focal = float((pixels / (high - low)[[0, 2]]).min()) * (FROM_M - CUT_M)
    camera = Intrinsics(pixels[0], pixels[1], focal, focal, pixels[0] / 2, pixels[1] / 2)
    pose = camera_to_world(np.array([[middle[0], FROM_M, middle[2]]]), yaw=np.zeros(1), pitch=np.array([-np.pi / 2]))
    opened = only(mesh, (heights.max(axis=1) < CUT_M) & (heights.min(axis=1) < CUT_M - 0.4))
    return seen(RaycastSimulator(Scene("plan", "", opened)), pose, camera, size)


def main() -> None:
    """Write docs/pictures/home.jpg."""
    scene = load_scene(f"builtin-home:{sys.argv[1] if len(sys.argv) > 1 else 16}")
    simulator = RaycastSimulator(scene)
    poses = heldout_poses(simulator, sensor_height_m=1.5)
    poses = poses[(poses[:, 1, 2] > LEVEL[0]) & (poses[:, 1, 2] < LEVEL[1])]
    depth = simulator.render(poses, Intrinsics.from_hfov(64, 48, hfov_deg=90.0), rgb=False).depth
    chosen = np.argsort(-depth.mean(axis=(1, 2)))[:4]
    camera = Intrinsics.from_hfov(2 * TILE[0], 2 * TILE[1], hfov_deg=90.0)
    beside = (2 * TILE[0] + GAP, 2 * TILE[1] + GAP)
    picture = Image.new("RGB", (2 * beside[0] + GAP, beside[1]), (255, 255, 255))
    picture.paste(plan(scene.mesh, beside), (0, 0))
    for index, pose in enumerate(chosen):
        x, y = beside[0] + GAP + (index % 2) * (TILE[0] + GAP), (index // 2) * (TILE[1] + GAP)
        picture.paste(seen(simulator, poses[pose : pose + 1], camera, TILE), (x, y))
    target = Path("docs/pictures/home.jpg")
    picture.save(target, quality=82, optimize=True)
    print(target)


if __name__ == "__main__":
    main()
