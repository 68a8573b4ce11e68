"""What an animation is worth in physical units: `quality` of its frames, and its `motion`."""

__all__: list[str] = []
