"""NCS, its swing, PBNS and SNUG behind one protocol, `method.Method`."""

__all__: list[str] = []
