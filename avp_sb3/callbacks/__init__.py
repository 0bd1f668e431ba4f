"""Callbacks for Stable-Baselines3: metrics, MLflow, Rerun and evaluation."""
