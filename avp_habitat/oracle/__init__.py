"""Offline planners with full knowledge of the scene, as reference ceilings for policies."""

from avp_habitat.oracle.policy import OraclePolicy, SurveyPolicy

__all__ = ["OraclePolicy", "SurveyPolicy"]
