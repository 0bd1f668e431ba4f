from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio_room import write_room

from avp_habitat.rollout.images import read_depth

pytest.importorskip("nerfstudio")

import nerfstudio.scripts.train  # noqa: F401  nerfstudio's modules import each other in circles; this way round is its own

from avp_nerfstudio.data.dataparser import AVPDataParserConfig, RGBDDataset
from avp_nerfstudio.method.config import trainer_config
from avp_nerfstudio.method.model import termination_loss


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("rollouts") / "room", frames=12)


def samples(rays=5, count=9, seed=0):
    edges = torch.from_numpy(np.sort(np.random.default_rng(seed).uniform(0.1, 5, (rays, count + 1)), axis=1))
    weights = torch.softmax(torch.from_numpy(np.random.default_rng(seed + 1).normal(size=(rays, count))), dim=1)
    return weights, edges[:, :-1], edges[:, 1:]


def test_the_loss_is_what_a_loop_over_rays_and_samples_gives():
    weights, starts, ends = samples()
    distance, tolerance = torch.tensor([0.0, 1.0, 2.5, 4.0, 20.0], dtype=torch.float64), 0.1
    losses = []
    for ray in range(1, 5):
        share = 0.0
        for start, end, weight in zip(starts[ray], ends[ray], weights[ray], strict=True):
            if start <= distance[ray] + tolerance and end >= distance[ray] - tolerance:
                share += float(weight)
        losses.append(np.log(1.001 / (share + 0.001)))
    loss = termination_loss(weights, starts, ends, distance, tolerance)
    assert float(loss) == pytest.approx(np.mean(losses))


def test_all_weight_at_the_surface_costs_nothing_and_none_of_it_costs_most():
    starts = torch.arange(4.0)[None]
    at_surface, before = torch.tensor([[0.0, 0, 1, 0]]), torch.tensor([[1.0, 0, 0, 0]])
    surface = torch.tensor([2.5])
    assert float(termination_loss(at_surface, starts, starts + 1, surface, 0.1)) == pytest.approx(0.0, abs=1e-6)
    assert float(termination_loss(before, starts, starts + 1, surface, 0.1)) > 6


def test_rays_without_depth_do_not_count():
    weights, starts, ends = samples()
    assert float(termination_loss(weights, starts, ends, torch.zeros(5), 0.1)) == 0.0


def test_the_dataset_gives_depth_in_units_of_the_scene_and_none_when_it_is_hidden(room):
    outputs = AVPDataParserConfig(data=room, scale=0.5).setup().get_dataparser_outputs("train")
    item = RGBDDataset(outputs)[3]
    expected = read_depth(room / "depth/frame_00003.png") * 0.5
    np.testing.assert_allclose(item["depth_image"][..., 0], expected, atol=1e-6)
    hidden = AVPDataParserConfig(data=room, depth=False).setup().get_dataparser_outputs("train")
    assert "depth_image" not in RGBDDataset(hidden)[3]


def trained(room: Path, output: Path, *, scale: float, **model):
    config = trainer_config()
    config.data = config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = room
    config.pipeline.datamanager.dataparser.scale = scale
    config.output_dir, config.vis, config.max_num_iterations = output, "tensorboard", 120
    config.pipeline.datamanager.train_num_rays_per_batch = 256
    for name, value in {"log2_hashmap_size": 12, **model}.items():
        setattr(config.pipeline.model, name, value)
    torch.manual_seed(0)
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    for step in range(120):
        trainer.train_iteration(step)
    trainer.pipeline.eval()
    return trainer.pipeline.get_average_eval_image_metrics()


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_depth_puts_the_surfaces_where_they_are(room, tmp_path, scale):
    with_depth = trained(room, tmp_path / "a", scale=scale)
    without = trained(room, tmp_path / "b", scale=scale, use_depth=False)
    assert with_depth["depth_error_m"] < 0.1
    assert with_depth["depth_error_m"] < 0.5 * without["depth_error_m"]
