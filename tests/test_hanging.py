"""An opening beside the sections of a trunk: how much wider it is, how alike in shape, where it is centred."""

import numpy as np
import pytest

from ncs_jax import io
from ncs_jax.prepare.hanging import ANGLES, RAYS, Trunk, opening_on, trunk_of, upper_opening

from .shapes import tube


def vase(wide=0.1, deep=0.06, height=1.0):
    """A body without a lid whose sections are ellipses, half as wide again at the bottom, with a loose ball at its side."""
    x, faces = tube(96, 41, 1.0, height)
    x = x * (np.array([wide, 0, deep]) * (1.5 - 0.5 * x[:, 1:2] / height) + [0, 1, 0])
    arm, more = tube(12, 41, 0.02, height)
    joints = np.zeros((1, 3))
    weights = np.ones((len(x) + len(arm), 1))
    vertices = np.concatenate([x, arm + [0.4, 0, 0]])
    return io.BodyRecord(vertices, np.concatenate([faces, more + len(x)]).astype(np.int32), joints, np.array([-1]), weights)


def ring(wide, deep, y, around=96):
    angle = 2 * np.pi * np.arange(around) / around
    return np.stack([wide * np.cos(angle), np.full(around, y), deep * np.sin(angle)], axis=1)


def test_sections_are_those_of_the_trunk_without_the_arms():
    trunk = trunk_of(vase())
    assert len(trunk.heights) > 100
    np.testing.assert_allclose(trunk.reach[:, 0], 0.1 * (1.5 - 0.5 * trunk.heights), rtol=1e-3)
    np.testing.assert_allclose(trunk.reach[:, 12], 0.06 * (1.5 - 0.5 * trunk.heights), rtol=1e-3)
    assert trunk.carries()[5:].all()  # it is wider below


def test_an_opening_tells_its_height_ease_and_middle():
    """A ring that is a section at 0.6 m made wider by 5 mm, and moved."""
    trunk = trunk_of(vase())
    size = 1.5 - 0.5 * 0.6
    section = ring(0.1 * size, 0.06 * size, 0)
    outward = section[:, [0, 2]] / np.array([0.1, 0.06]) ** 2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    section[:, [0, 2]] += 0.005 * outward + [0.03, -0.02]
    fit = opening_on(trunk, section)
    best = int(fit.misfit.argmin())
    assert fit.heights[best] == pytest.approx(0.6, abs=0.01) and fit.ease[best] == pytest.approx(0.005, abs=5e-4)
    np.testing.assert_allclose(fit.shift[best], [-0.03, 0.02], atol=1e-4)
    assert fit.misfit[best] < 1e-4 and fit.misfit[best + 30] > 5 * fit.misfit[best]


@pytest.mark.parametrize(("shape", "up"), [((1.0, 1.0), 0.0), ((1.0, 0.0), 0.1), ((0.0, 1.0), -0.1)])
def test_a_waist_is_held_as_well_elsewhere_where_the_trunk_is_as_wide_and_in_line(shape, up):
    """A round trunk, 10 cm in radius at 1 m, of another girth 10 cm below and above (1) or of the same there (0)."""
    heights = np.array([0.9, 1.0, 1.1])
    trunk = Trunk(heights, np.repeat([[0.1 + 0.03 * shape[0]], [0.1], [0.1 + 0.03 * shape[1]]], ANGLES, axis=1))
    waist = ring(0.11, 0.11, 1.0, around=480)
    assert opening_on(trunk, waist).farther(1, tall=1.7) == pytest.approx(up, abs=1e-9)
    bent = Trunk(heights, trunk.reach + np.array([[0.02], [0], [0.02]]) * RAYS[:, 1])  # it is not in line there
    assert opening_on(bent, waist).farther(1, tall=1.7) == 0.0


def test_a_tube_hangs_from_its_upper_opening():
    upper, lower = ring(0.1, 0.06, 0.9), ring(0.2, 0.2, 0.5)
    assert upper_opening([lower, upper]) is upper
    assert upper_opening([lower, ring(0.01, 0.01, 0.7), upper]) is upper  # with a buttonhole
    assert upper_opening([lower, lower + [0.5, 0, 0], upper]) is None  # trousers
    assert upper_opening([upper, upper + [0.5, 0, 0]]) is None  # side by side
    tilted = upper + upper[:, :1] * [0, 1, 0]
    assert upper_opening([lower, tilted]) is None
