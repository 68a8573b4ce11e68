"""Neural Cloth: train a garment on a character's actions, bake it, and see it live."""


def register() -> None:
    """Add the panel to Blender."""
    from . import panel  # which needs Blender; other parts do not

    panel.register()


def unregister() -> None:
    """Take the panel away, and end what runs."""
    from . import panel

    panel.unregister()
