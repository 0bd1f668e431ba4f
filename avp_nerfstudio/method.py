"""The method `avp-nerfacto` as nerfstudio registers it."""

from nerfstudio.plugins.types import MethodSpecification

from avp_nerfstudio.config import trainer_config


def avp_nerfacto() -> MethodSpecification:
    """Nerfacto with settings that a CPU can bear, reading rollouts with `avp-data`."""
    return MethodSpecification(
        config=trainer_config(),
        description="nerfacto for a room captured as a rollout: minutes on a CPU, no network needed.",
    )
