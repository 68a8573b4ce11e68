"""Runs: train into a folder, resume it, open it; simulate a scene."""

__all__: list[str] = []
