"""Make the README's picture: three generated rooms and the map of a rollout, the demo's by default."""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from avp_habitat.poses import Intrinsics
from avp_habitat.sight.heldout import heldout_poses
from avp_habitat.simulators.registry import make_simulator

TILE = (480, 360)
GAP = 4


def room(seed: int) -> Image.Image:
    """The held-out view of a room that sees second farthest, rendered twice as large and reduced."""
    simulator = make_simulator("raycast", f"builtin:{seed}")
    poses = heldout_poses(simulator, sensor_height_m=1.5)
    depth = simulator.render(poses, Intrinsics.from_hfov(64, 48, hfov_deg=90.0), rgb=False).depth
    chosen = np.argsort(-depth.mean(axis=(1, 2)))[1]
    camera = Intrinsics.from_hfov(2 * TILE[0], 2 * TILE[1], hfov_deg=90.0)
    picture = simulator.render(poses[chosen : chosen + 1], camera, rgb=True).rgb
    assert picture is not None
    return Image.fromarray(picture[0]).resize(TILE, Image.Resampling.LANCZOS)


def main() -> None:
    """Write docs/pictures/overview.png."""
    rollout = Path(sys.argv[1] if len(sys.argv) > 1 else "runs/demo/cells/collect/proposed-builtin_0-0-0/rollout")
    with Image.open(rollout / "trajectory.png") as found:
        drawn = found.convert("RGB")
    drawn.thumbnail(TILE, Image.Resampling.LANCZOS)
    last = Image.new("RGB", TILE, (248, 248, 246))
    last.paste(drawn, ((TILE[0] - drawn.width) // 2, (TILE[1] - drawn.height) // 2))
    picture = Image.new("RGB", (2 * TILE[0] + GAP, 2 * TILE[1] + GAP), (255, 255, 255))
    for index, tile in enumerate([room(0), room(1), room(4), last]):
        picture.paste(tile, ((index % 2) * (TILE[0] + GAP), (index // 2) * (TILE[1] + GAP)))
    target = Path("docs/pictures/overview.png")
    picture.quantize(192).save(target, optimize=True)
    print(target)


if __name__ == "__main__":
    main()
