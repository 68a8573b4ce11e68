"""Full-space simulation: implicit Euler of the energy that trains the network."""

__all__: list[str] = []
