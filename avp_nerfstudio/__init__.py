"""Plug-ins for nerfstudio: what opens a rollout there and what reconstructs it."""
