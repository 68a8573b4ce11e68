"""Experiments: each is importable, takes a size, and writes a table and a picture."""

from ncs_jax.cli.parser import quieten_jaxlib

quieten_jaxlib()
