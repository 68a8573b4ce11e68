"""Animated garments: one format a file."""

__all__: list[str] = []
