"""Geometry without physics: safe norms, vectors, rotations, meshes, skinning, smooth modes."""

__all__: list[str] = []
