"""Scenes as textured triangle meshes: read from files, or generated."""
