"""The solver of one frame: directions, line search, factorisations, patches, derivatives."""

__all__: list[str] = []
