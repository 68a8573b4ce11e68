"""Contact of cloth with the body and with itself: who is near whom, how far apart, and what that costs."""

__all__: list[str] = []
