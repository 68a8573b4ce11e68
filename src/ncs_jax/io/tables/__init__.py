"""Named arrays in .npz and .h5, and what the reading and writing of all files has in common."""

__all__: list[str] = []
