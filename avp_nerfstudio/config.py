"""The settings of `avp-nerfacto`, chosen by measurement for a room and two CPU cores."""

from dataclasses import dataclass

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManager, VanillaDataManagerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from avp_nerfstudio.dataparser import AVPDataParserConfig
from avp_nerfstudio.dataset import RGBDDataset
from avp_nerfstudio.model import AVPNerfactoModelConfig
from avp_nerfstudio.trainer import AVPTrainerConfig

ITERATIONS = 2500


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam in one pass over the parameters."""

    fused: bool = True
    """Whether torch's fused implementation is used; several times faster on hash tables."""


def _optimizer(iterations: int) -> dict[str, object]:
    return {
        "optimizer": FusedAdamConfig(lr=2e-2, eps=1e-15),
        "scheduler": ExponentialDecaySchedulerConfig(lr_final=1e-3, max_steps=iterations),
    }


def set_iterations(config: TrainerConfig, iterations: int) -> None:
    """Train for so many iterations, with the learning rates falling over just these."""
    config.max_num_iterations = iterations
    for group in config.optimizers.values():
        group["scheduler"].max_steps = iterations


def trainer_config() -> AVPTrainerConfig:
    """The whole configuration, for CUDA where there is a device and else for the CPU."""
    cuda = torch.cuda.is_available()
    return AVPTrainerConfig(
        method_name="avp-nerfacto",
        max_num_iterations=ITERATIONS,
        # Pictures are scored once, by ns-eval; doing so while training would take longer than the training.
        steps_per_eval_batch=0,
        steps_per_eval_image=0,
        steps_per_eval_all_images=0,
        # A checkpoint is a few megabytes, so an interrupted training keeps nearly all it had.
        steps_per_save=500,
        mixed_precision=cuda,
        machine=MachineConfig(device_type="cuda" if cuda else "cpu"),
        pipeline=VanillaPipelineConfig(
            datamanager=VanillaDataManagerConfig(
                _target=VanillaDataManager[RGBDDataset],
                dataparser=AVPDataParserConfig(),
                train_num_rays_per_batch=1024,
                eval_num_rays_per_batch=1024,
            ),
            model=AVPNerfactoModelConfig(
                implementation="tcnn" if cuda else "torch",
                eval_num_rays_per_chunk=1 << 13,
                num_levels=10,
                max_res=1024,
                log2_hashmap_size=17,
                hidden_dim=64,
                hidden_dim_color=64,
                num_nerf_samples_per_ray=8,
                num_proposal_samples_per_ray=(64,),
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
        optimizers={"proposal_networks": _optimizer(ITERATIONS), "fields": _optimizer(ITERATIONS)},
        # The trainer has a progress bar of its own, and its last lines are better the last.
        logging=LoggingConfig(steps_per_log=50, local_writer=LocalWriterConfig(enable=False), profiler="none"),
        viewer=ViewerConfig(websocket_host="127.0.0.1", num_rays_per_chunk=1 << 13, quit_on_train_completion=True),
        vis="tensorboard",
    )
