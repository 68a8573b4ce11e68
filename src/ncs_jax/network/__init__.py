"""The network: encoders, decoder, rollout, and the methods that put them together."""

__all__: list[str] = []
