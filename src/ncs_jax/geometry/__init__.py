"""Geometry without physics: safe norms, rotations, meshes, skinning, smooth modes."""

__all__: list[str] = []
