"""Simulators by name: ray casting, and Habitat-Sim."""
