"""Garment meshes: one format a file."""

__all__: list[str] = []
