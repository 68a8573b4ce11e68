"""Straps over shoulders: how far a garment is lifted to rest on them."""

import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.prepare.straps import REST, lift_to_rest

from .shapes import ball


def shoulders(height=1.7):
    """Two balls, 9 cm in radius, whose tops are at 1.4 m, and one far below: a body of that height."""
    x, faces = ball(4, 0.09)
    places = [[-0.12, 1.31, 0], [0.12, 1.31, 0], [0, 1.49 - height + 0.09 - 0.09, 0]]
    vertices = np.concatenate([x + p for p in places])
    triangles = np.concatenate([faces + k * len(x) for k in range(3)]).astype(np.int32)
    return io.BodyRecord(vertices, triangles, np.zeros((1, 3)), np.array([-1]), np.ones((len(vertices), 1)))


def strap(x, gap):
    """A strip along z, 2 cm wide, its two edges as curved as the shoulder, the top a gap above it, its ends 6 cm lower."""
    z = np.linspace(-0.1, 0.1, 11)
    ends = [[x + side, 1.4 + gap - 6 * w**2, w] for w in z for side in (-0.01, 0.01)]
    k = 2 * np.arange(10)[:, None]
    return np.array(ends), np.concatenate([k + [0, 2, 1], k + [1, 2, 3]]).astype(np.int32)


@pytest.mark.parametrize("gap", [-0.02, 0.002, 0.03])
def test_straps_are_lifted_to_where_they_rest(gap):
    body = shoulders()
    (a, faces), (b, _) = strap(-0.12, gap), strap(0.12, gap)
    x = np.concatenate([a, b])
    tall = float(np.ptp(body.vertices, axis=0).max())
    lift = lift_to_rest(x, np.concatenate([faces, faces + len(a)]), body)
    assert lift == pytest.approx(REST * tall - gap, abs=0.004)
    assert lift_to_rest(a, faces, body) is None  # on one side alone nothing rests
    assert lift_to_rest(x - [0, 0.6, 0], np.concatenate([faces, faces + len(a)]), body) is None
