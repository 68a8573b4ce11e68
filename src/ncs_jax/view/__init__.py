"""Pictures, pages and the live view."""

__all__: list[str] = []
