"""The method `avp-nerfacto` as nerfstudio registers it."""

from avp_nerfstudio.config import trainer_config
from nerfstudio.plugins.types import MethodSpecification


def avp_nerfacto() -> MethodSpecification:
    """nerfacto with settings that a CPU can bear, reading rollouts with `avp-data`."""
    return MethodSpecification(
        config=trainer_config(),
        description="nerfacto for a room captured as a rollout: minutes on a CPU, no network needed.",
    )
