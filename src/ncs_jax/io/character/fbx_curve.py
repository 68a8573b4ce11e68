"""Animation curves in FBX: one number over time, by keys with constant, linear or cubic spans between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ncs_jax.io.character.fbx import Fbx, Record
from ncs_jax.io.character.spline import hermite, onto_keys

__all__ = ["Curve", "curve_from"]

CONSTANT, LINEAR = 2, 4  # flags of KeyAttrFlags for the span after a key; without either it is cubic
NEXT, GIVEN = 0x100, 0x400  # a constant span has the next key's value; the slopes are given, not found from the neighbours


@dataclass(frozen=True, eq=False)
class Curve:
    """Keys: times (K,), s, rising; values (K,); slopes (K, 2) on leaving a key and on arriving at the next; flags (K,)."""

    times: np.ndarray
    values: np.ndarray
    slopes: np.ndarray
    flags: np.ndarray

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the values (n,) at times (n,), s; constant before the first key and after the last.

        A cubic span is Hermite's. The weights of its tangents, which bend time along it, are ignored.
        """
        last = len(self.times) - 1
        times = onto_keys(np.clip(times, self.times[0], self.times[-1]), self.times)
        low = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, max(last - 1, 0))
        high = np.minimum(low + 1, last)
        span = self.times[high] - self.times[low]
        t = (times - self.times[low]) / np.where(span > 0, span, 1)
        a, b, flags = self.values[low], self.values[high], self.flags[low]
        linear = a + t * (b - a)
        cubic = hermite(t, span, a, b, self.slopes[low, 0], self.slopes[low, 1])
        held = np.where((flags & NEXT > 0) & (t > 0) | (t >= 1), b, a)
        return np.where(flags & CONSTANT > 0, held, np.where(flags & LINEAR > 0, linear, cubic))


def curve_from(fbx: Fbx, record: Record, where: str, tick: int) -> Curve:
    """Return the keys of an AnimationCurve; `tick` is how many units of its times make a second."""
    times = fbx.array(record, "KeyTime", where, whole=True) / tick
    values = fbx.array(record, "KeyValueFloat", where)
    flags = fbx.array(record, "KeyAttrFlags", where, whole=True)
    data = fbx.array(record, "KeyAttrDataFloat", where)
    counts = fbx.array(record, "KeyAttrRefCount", where, whole=True)
    if not len(times) or len(values) != len(times) or (np.diff(times) <= 0).any():
        raise fbx.wrong("a value for each of the rising times expected", where, f"{len(values)} for {len(times)}")
    if len(flags) != len(counts) or len(data) != 4 * len(flags) or (counts < 0).any() or counts.sum() != len(times):
        if len(flags):
            raise fbx.wrong("attributes of each key expected", where, f"{len(flags)}, {len(data)}, {len(counts)}")
        flags, data, counts = np.array([LINEAR]), np.zeros(4), np.array([len(times)])
    flags = np.repeat(flags, counts)
    given = np.repeat(data.reshape(-1, 4)[:, :2], counts, axis=0)
    through = _through(times, values)
    free = flags & GIVEN == 0
    leaving = np.where(free, through, given[:, 0])
    free_next = np.append(free[1:], True)
    arriving = np.where(free_next, np.append(through[1:], through[-1]), given[:, 1])
    return Curve(times, values, np.stack([leaving, arriving], axis=1), flags)


def _through(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the slopes of automatic tangents: half from neighbour to neighbour, half the mean beside the key, by time.

    Bias and clamping, which only curves made by an animator have, are ignored.
    """
    if len(times) == 1:
        return np.zeros(1)
    span = np.diff(times)
    beside = np.diff(values) / span
    share = span[:-1] / (span[:-1] + span[1:])
    inner = (values[2:] - values[:-2]) / (times[2:] - times[:-2]) / 2 + ((1 - share) * beside[:-1] + share * beside[1:]) / 2
    return np.concatenate([beside[:1], inner, beside[-1:]])
