"""Twenty garments that no simulation should begin from: ten in the body, ten through themselves."""

from __future__ import annotations

import numpy as np

from ncs_jax import io


def twenty_starts() -> dict[str, io.GarmentRecord]:
    """The packaged T-shirt and skirt pushed, scaled and folded: each is inside the packaged body, or passes through itself."""
    shirt, skirt = io.read_garment("ncs:tshirt"), io.read_garment("ncs:skirt")
    made = {}

    def add(name: str, garment: io.GarmentRecord, x: np.ndarray) -> None:
        made[name] = io.GarmentRecord(x.astype(np.float32), garment.faces, groups=garment.groups)

    for name, garment in (("shirt", shirt), ("skirt", skirt)):
        x = garment.vertices.astype(np.float64)
        middle, low, high = x.mean(axis=0), x.min(axis=0), x.max(axis=0)
        up = (x[:, 1] - low[1]) / (high[1] - low[1])
        front = x[:, 2] > middle[2]
        for way, amount in (((0, 0, 1), 0.03), ((1, 0, 0), 0.025), ((0, 0, -1), 0.05)):  # in the body: pushed,
            add(f"{name} pushed {amount} along {way}", garment, x + amount * np.array(way))
        for factor in (0.9, 0.8):  # and scaled about the vertical in its middle
            add(f"{name} scaled by {factor}", garment, middle + (x - middle) * [factor, 1, factor])
        hem = np.clip(1 - up / 0.15, 0, 1)[:, None]  # through itself: the hem of the front through that of the back,
        add(f"{name} hem through", garment, x - hem * front[:, None] * [0, 0, 2.2] * (x - middle) * [0, 0, 1])
        inner = np.exp(-np.sum(((x - [middle[0], low[1] + 0.1, high[2]]) / 0.05) ** 2, axis=1))[:, None]
        add(f"{name} pressed through the back", garment, x - inner * [0, 0, 1.2 * (high[2] - low[2])])
        near = np.argsort(np.linalg.norm(x - x[front][up[front].argmin()], axis=1))
        for label, count, size in (("spike", 1, 0.5), ("crumple", 30, 0.05)):  # a vertex pulled through the back; a noisy patch
            y = x.copy()
            noise = np.random.default_rng(0).normal(size=(count, 3)) if count > 1 else np.array([[0.03, 0.2, -1]])
            y[near[:count]] += size * noise
            add(f"{name} {label}", garment, y)
        folded = np.maximum(0.25 - up, 0) * (high[1] - low[1])  # the lower end turned up, outside at first and then inside
        y = x + folded[:, None] * [0, 2, 0]
        wide = np.where(folded > 0, 1.05 - 0.5 * folded / folded.max(), 1)
        y[:, [0, 2]] = middle[[0, 2]] + (y - middle)[:, [0, 2]] * wide[:, None]
        add(f"{name} folded", garment, y)
    return made
