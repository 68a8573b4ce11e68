"""Experiments: each is importable, takes a size, and writes a table and a picture."""
