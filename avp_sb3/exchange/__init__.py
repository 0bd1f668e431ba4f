"""Policies between Stable-Baselines3, the files of `avp_habitat.policies.weights`, and ONNX."""
