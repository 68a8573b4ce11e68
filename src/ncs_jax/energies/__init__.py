"""The energies, one law a file; `total` adds them up as equation (10)."""

__all__: list[str] = []
