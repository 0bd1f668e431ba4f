"""Tags that every MLflow run gets while the suite is in use: the plug of group `mlflow.run_context_provider`."""

import os
import platform
import sys

from mlflow.tracking.context.abstract_context import RunContextProvider

from avp_habitat.provenance import PACKAGES, git_commit, installed_versions
from avp_habitat.simulators.registry import open_scenes
from avp_habitat.tracking.names import MAX_TAG

_USERS = ("avp_habitat.task.env", "avp_sb3", "avp_nerfstudio")


class AVPContext(RunContextProvider):
    """System, package versions, git commit, and names and digests of the scenes that are open in this process."""

    def in_context(self) -> bool:
        """Whether this program uses the suite; installed alone, it must not mark other people's runs."""
        return any(name in sys.modules for name in _USERS)

    def tags(self) -> dict[str, str]:
        """The tags."""
        tags = {f"version.{name}": version for name, version in installed_versions(PACKAGES).items()}
        tags |= {"system.platform": platform.platform(), "system.cores": str(os.cpu_count())}
        tags |= {"system.processor": platform.processor() or platform.machine()}
        if (commit := git_commit()) is not None:
            tags["mlflow.source.git.commit"] = commit
        if scenes := open_scenes():
            tags["avp.scene"] = ", ".join(scenes)[:MAX_TAG]
            tags["avp.scene_digest"] = ", ".join(scenes.values())[:MAX_TAG]
        return tags
