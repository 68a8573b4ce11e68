"""A scene: its fields (`spec`), its constants (`model`), and a motion as network and energies read it (`features`)."""

__all__: list[str] = []
