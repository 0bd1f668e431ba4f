"""Habitat-Sim as a simulator of the suite."""

from avp_habitat.simulators.habitat.simulator import HabitatSimulator

__all__ = ["HabitatSimulator"]
