"""Checks that the poses, intrinsics and depth of a rollout belong together."""
