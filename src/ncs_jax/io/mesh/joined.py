"""Garments that are worn together, as one mesh."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ncs_jax.io.records import GarmentRecord

__all__ = ["garment_names", "worn_together"]


def worn_together(names: Sequence[str], garments: Sequence[GarmentRecord]) -> GarmentRecord:
    """Return garments, from the skin outwards, as one record: the vertices and triangles of the first, then of the next.

    Vertex groups of one name become one; a group by its file's name ("shirt" of shirt.obj, "shirt 2" of a second) has all of
    each garment. Texture coordinates and skinning weights are kept where all have some.

    Args:
        names: of their files. garments: in metres, Y up.
    """
    count = np.cumsum([0, *(len(g.vertices) for g in garments)])
    groups: dict[str, list[np.ndarray]] = {}
    for first, garment in zip(count, garments, strict=False):
        for group, vertices in garment.groups.items():
            groups.setdefault(group, []).append(first + vertices)
    own = zip(garment_names(names, groups), itertools.pairwise(count), strict=True)
    groups |= {name: [np.arange(*ends)] for name, ends in own}
    uv, weights = ([getattr(g, what) for g in garments] for what in ("uv", "weights"))
    skinned = all(w is not None for w in weights)
    notes = [note for g in garments for note in g.notes]
    if not skinned and any(w is not None for w in weights):
        notes.append("the garments' own skinning weights are not used: not all of them have some")
    if any(each is not None for each in uv) and (
        bare := next((n for n, each in zip(names, uv, strict=True) if each is None), "")
    ):
        notes.append(f"texture coordinates are not used: {bare} has none")
    inner = garments[0]
    return GarmentRecord(
        np.concatenate([g.vertices for g in garments]),
        np.concatenate([first + g.faces for first, g in zip(count, garments, strict=False)]).astype(np.int32),
        np.concatenate(uv) if all(each is not None for each in uv) else None,
        {name: np.concatenate(parts).astype(np.int32) for name, parts in groups.items()},
        inner.scale,
        inner.up,
        sum(g.welded for g in garments),
        np.concatenate(weights) if skinned else None,
        inner.joint_names if skinned else (),
        tuple(notes),
        tuple(int(first) for first in count[1:-1]),
    )


def garment_names(files: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return what garments are called: as their files, or as the mesh in FILE#MESH.

    They are unlike each other and those taken: a second "shirt" is "shirt 2".
    """
    found: list[str] = []
    for file in files:
        name = Path(file).name.rpartition("#")[2] if "#" in Path(file).name else Path(file.removeprefix("ncs:")).stem
        free = (f"{name} {k}" if k > 1 else name for k in itertools.count(1))
        found.append(next(each for each in free if each not in (*taken, *found)))
    return found
