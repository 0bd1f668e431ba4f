import numpy as np
import pytest
import torch
from nerfstudio_room import ROOM, distance_to_walls, write_room

from avp_habitat.poses import z_up_to_y_up

pytest.importorskip("nerfstudio")

import nerfstudio.scripts.train  # noqa: F401  nerfstudio's modules import each other in circles; this way round is its own
from nerfstudio.cameras.rays import Frustums, RaySamples
from nerfstudio.field_components.field_heads import FieldHeadNames

from avp_nerfstudio.data.dataparser import AVPDataParserConfig, RGBDDataset
from avp_nerfstudio.method.config import trainer_config
from avp_nerfstudio.method.model import SurfaceGrid, measured_points

BOX = torch.tensor([[0.0, -1.0, 0.0], [2.0, 1.0, 1.0]])


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("rollouts") / "room", frames=12)


def to_y_up(points):
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    return z_up_to_y_up(homogeneous[..., None])[:, :3, 0]


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_measured_points_lie_on_the_walls(room, scale):
    dataset = RGBDDataset(AVPDataParserConfig(data=room, scale=scale).setup().get_dataparser_outputs("train"))
    for index in range(len(dataset)):
        points = measured_points(dataset.cameras, index, dataset[index]["depth_image"])
        assert len(points) == 32 * 24
        assert distance_to_walls(to_y_up(points.numpy() / scale)).max() < 0.005


def test_matter_is_left_around_measured_points_only():
    grid = SurfaceGrid(BOX, 0.1)
    everywhere = torch.tensor([[0.55, 0.05, 0.95], [1.9, -0.9, 0.1], [2.5, 0.0, 0.5]])
    assert grid(everywhere).tolist() == [True, True, False]
    grid.fill([torch.tensor([[0.55, 0.05, 0.55]]), torch.tensor([[9.0, 9.0, 9.0]])])
    near = torch.tensor(
        [[0.55, 0.05, 0.55], [0.35, 0.25, 0.75], [0.85, 0.05, 0.55], [1.9, -0.9, 0.1], [0.55, 0.05, 1.2]]
    )
    assert grid(near).tolist() == [True, True, False, False, False]
    assert int(grid.occupied.sum()) == 5**3


def test_the_grid_is_part_of_the_checkpoint():
    filled, fresh = SurfaceGrid(BOX, 0.1), SurfaceGrid(BOX, 0.1)
    filled.fill([torch.tensor([[0.5, 0.0, 0.5]])])
    fresh.load_state_dict(filled.state_dict())
    assert bool(fresh.carved)
    assert torch.equal(fresh.occupied, filled.occupied)


def test_large_scenes_get_larger_voxels():
    grid = SurfaceGrid(torch.tensor([[0.0, 0.0, 0.0], [100.0, 50.0, 3.0]]), 0.05)
    assert max(grid.occupied.shape) <= 256


def model(room, output, **options):
    config = trainer_config()
    config.data = config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = room
    config.output_dir, config.vis = output, "tensorboard"
    for name, value in {"log2_hashmap_size": 10, **options}.items():
        setattr(config.pipeline.model, name, value)
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer.pipeline.model


def densities(made, points):
    return made.density_fns[0](points), made.field.density_fn(points[:, None])


def test_space_is_carved_by_depth_before_training_and_only_then(room, tmp_path):
    turned = torch.tensor(ROOM.mean(axis=0), dtype=torch.float32)[[0, 2, 1]] * torch.tensor([1.0, -1.0, 1.0])
    middle = turned[None]
    dataset = RGBDDataset(AVPDataParserConfig(data=room).setup().get_dataparser_outputs("train"))
    wall = measured_points(dataset.cameras, 0, dataset[0]["depth_image"])[:1]
    carved = model(room, tmp_path / "a")
    for density in densities(carved, middle):
        assert density.item() == 0.0
    for density in densities(carved, wall):
        assert density.item() > 0.0
    for options in ({"use_depth": False}, {"carving_voxel_m": 0.0}):
        for density in densities(model(room, tmp_path / "b", **options), middle):
            assert density.item() > 0.0


@pytest.mark.parametrize("view_dependent", [False, True])
def test_colours_change_with_the_direction_only_when_asked_for(room, tmp_path, view_dependent):
    made = model(room, tmp_path, view_dependent=view_dependent, use_depth=False).eval()

    def colour(direction):
        towards, one = torch.tensor(direction)[None, None], torch.ones(1, 1, 1)
        # All rays pass through the same point, at a distance of 1.
        frustums = Frustums(origins=-towards, directions=towards, starts=one, ends=one, pixel_area=one)
        samples = RaySamples(frustums=frustums, camera_indices=torch.zeros(1, 1, 1, dtype=torch.long))
        return made.field(samples)[FieldHeadNames.RGB]

    same = torch.allclose(colour([1.0, 0.0, 0.0]), colour([0.0, 0.6, -0.8]), atol=1e-6)
    assert same is not view_dependent
