"""An offline planner with full knowledge of the scene, as a reference ceiling for policies."""

from avp_habitat.oracle.policy import OraclePolicy

__all__ = ["OraclePolicy"]
