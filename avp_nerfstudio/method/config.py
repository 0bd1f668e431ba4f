"""The method `avp-nerfacto` as nerfstudio registers it."""

from dataclasses import dataclass

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig
from nerfstudio.plugins.types import MethodSpecification

from avp_nerfstudio.data.dataparser import AVPDataParserConfig, RGBDDataset
from avp_nerfstudio.method.model import AVPNerfactoModelConfig
from avp_nerfstudio.method.trainer import AVPTrainerConfig


@dataclass(frozen=True)
class Size:
    """How much a device can bear."""

    iterations: int
    """Of the training."""
    rays: int
    """Per iteration."""
    rays_per_chunk: int
    """When rendering."""
    proposal_samples: int
    """Per ray, uniformly in the scene box; in carved space they cost next to nothing."""
    samples: int
    """Of the field per ray."""
    levels: int
    """Of the field's hash encoding."""
    log2_table: int
    """Rows of the table of each level, as a power of two."""
    finest: int
    """Cells of the finest level along the scene box."""


# By trials on white_room (docs/reconstruction.md): more and cheaper rays beat more samples on each.
CPU = Size(6000, 1024, 1 << 12, proposal_samples=64, samples=8, levels=10, log2_table=17, finest=1024)
# The tables and rays of nerfacto; not measured, for want of such a device.
CUDA = Size(30_000, 4096, 1 << 15, proposal_samples=128, samples=24, levels=16, log2_table=19, finest=2048)


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam in one pass over the parameters."""

    fused: bool = True
    """Whether torch's fused implementation is used; several times faster on hash tables."""


def _optimizer() -> dict[str, object]:
    # The trainer stretches the schedule over the training, however long it is.
    return {
        "optimizer": FusedAdamConfig(lr=2e-2, eps=1e-15),
        "scheduler": ExponentialDecaySchedulerConfig(lr_final=1e-3),
    }


def trainer_config() -> AVPTrainerConfig:
    """The whole configuration, for CUDA where there is a device and else for the CPU."""
    cuda = torch.cuda.is_available()
    size = CUDA if cuda else CPU
    return AVPTrainerConfig(
        method_name="avp-nerfacto",
        max_num_iterations=size.iterations,
        # Pictures are scored once, by ns-eval; doing so while training would take longer than the training.
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        steps_per_save=1000,
        mixed_precision=cuda,
        machine=MachineConfig(device_type="cuda" if cuda else "cpu"),
        pipeline=VanillaPipelineConfig(
            datamanager=VanillaDataManagerConfig(
                _target=VanillaDataManager[RGBDDataset],
                dataparser=AVPDataParserConfig(),
                train_num_rays_per_batch=size.rays,
                eval_num_rays_per_batch=size.rays,
            ),
            model=AVPNerfactoModelConfig(
                implementation="tcnn" if cuda else "torch",
                eval_num_rays_per_chunk=size.rays_per_chunk,
                num_levels=size.levels,
                max_res=size.finest,
                log2_hashmap_size=size.log2_table,
                hidden_dim=64,
                hidden_dim_color=64,
                num_nerf_samples_per_ray=size.samples,
                num_proposal_samples_per_ray=(size.proposal_samples,),
                num_proposal_iterations=1,
                proposal_initial_sampler="uniform",
                proposal_net_args_list=[
                    {"hidden_dim": 16, "log2_hashmap_size": 15, "num_levels": 5, "max_res": 128, "use_linear": False}
                ],
                proposal_warmup=500,
                proposal_weights_anneal_max_num_iters=100,
                use_appearance_embedding=False,
                average_init_density=0.01,
                camera_optimizer=CameraOptimizerConfig(mode="off"),
            ),
        ),
        optimizers={"proposal_networks": _optimizer(), "fields": _optimizer()},
        # The trainer has a progress bar of its own, and its last lines are better the last.
        logging=LoggingConfig(steps_per_log=50, local_writer=LocalWriterConfig(enable=False), profiler="none"),
        viewer=ViewerConfig(
            websocket_host="127.0.0.1", num_rays_per_chunk=size.rays_per_chunk, quit_on_train_completion=True
        ),
        vis="tensorboard",
    )


def avp_nerfacto() -> MethodSpecification:
    """Nerfacto with settings that a CPU can bear, reading rollouts with `avp-data`."""
    return MethodSpecification(
        config=trainer_config(),
        description="nerfacto for a room captured as a rollout: minutes on a CPU, no network needed.",
    )
