"""One step of a trained garment as a file for hosts without this package."""

__all__: list[str] = []
