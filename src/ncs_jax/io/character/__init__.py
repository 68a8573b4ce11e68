"""Characters and their motions: skeletons, skins, joint rotations; one format a file."""

__all__: list[str] = []
