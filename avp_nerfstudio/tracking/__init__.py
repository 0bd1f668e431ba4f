"""Trainings of nerfstudio as MLflow runs and Rerun recordings."""
