"""`python -m ncs_jax.cli` is `ncs`."""

import sys

from ncs_jax.cli.parser import main

__all__: list[str] = []

if __name__ == "__main__":
    sys.exit(main())
