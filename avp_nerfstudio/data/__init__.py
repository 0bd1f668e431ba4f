"""Rollouts as data of nerfstudio: the dataparser `avp-data`, frames, points and held-out views."""
