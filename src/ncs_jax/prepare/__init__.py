"""From files to a scene that is ready: read, retarget, fit, check, build."""

__all__: list[str] = []
