"""A tiny training of `avp-nerfacto` in this process, for the tests of what happens around trainings."""

import dataclasses

from nerfstudio.scripts import train as ns_train
from nerfstudio.utils import writer

from avp_nerfstudio.method.config import trainer_config
from avp_nerfstudio.method.trainer import AVPTrainerConfig


def tiny_config(room, folder, *, iterations=12, **options):
    """`avp-nerfacto` with tables and rays for a moment's training on a CPU."""
    base = trainer_config()
    values = {field.name: getattr(base, field.name) for field in dataclasses.fields(base) if field.name != "_target"}
    config = AVPTrainerConfig(**{**values, "mlflow": "off", **options})
    config.machine.device_type = "cpu"
    config.data, config.output_dir = room, folder
    config.experiment_name, config.timestamp = "e", "t"
    config.max_num_iterations, config.steps_per_save = iterations, 1000
    config.pipeline.datamanager.train_num_rays_per_batch = 64
    config.pipeline.model.implementation = "torch"
    config.pipeline.model.log2_hashmap_size = 8
    config.logging.steps_per_log = 5
    config.logging.local_writer.enable = False
    config.logging.profiler = "none"
    return config


def train(config):
    """Train; gives the config.yml."""
    writer.EVENT_WRITERS.clear()
    writer.EVENT_STORAGE.clear()
    writer.GLOBAL_BUFFER.clear()
    ns_train.main(config)
    return config.get_base_dir() / "config.yml"
