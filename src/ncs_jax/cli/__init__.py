"""The command line: one file a group of commands, which read options, call the package and print."""

from ncs_jax.cli.parser import main

__all__ = ["main"]
