"""Tables of arrays: .npz, .h5 and what all files have in common."""

__all__: list[str] = []
