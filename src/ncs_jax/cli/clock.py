"""Write times as a person reads them."""

from __future__ import annotations

__all__ = ["clock"]


def clock(seconds: float) -> str:
    """Return seconds as minutes:seconds, with hours where there are any."""
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"
