"""Training: the loss of a batch and one optimiser step, on any number of devices."""

__all__: list[str] = []
