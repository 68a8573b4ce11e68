"""Which meshes of a file are meant, by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ncs_jax.errors import InputError

__all__ = ["NamedMesh", "chosen_meshes", "one_object"]

LISTED = 40  # meshes that a message names


@dataclass(frozen=True)
class NamedMesh:
    """A mesh of a file, or the part of it that has one material.

    Attributes:
        name: of the object, "" where the file has none. owner: the object's number. vertices: how many. others: more names that
            mean it, such as its mesh's. material: its name, or "".
    """

    name: str
    owner: int
    vertices: int
    others: tuple[str, ...] = ()
    material: str = ""

    def called(self, name: str) -> bool:
        """Tell whether a name means this mesh."""
        return bool(name) and name in (self.name, self.material, *self.others)


def chosen_meshes(file: Path, field: str, wanted: Sequence[str], meshes: Sequence[NamedMesh]) -> np.ndarray:
    """Return which meshes (M,) are meant by the wanted names, of objects, meshes or materials; all where none is wanted.

    The only mesh of a file that names none may be called anything.

    Raises:
        InputError: a name means no mesh of the file. The message lists what is there.
    """
    if not wanted or (len(meshes) == 1 and not meshes[0].name and not meshes[0].material):
        return np.ones(len(meshes), bool)
    for name in wanted:
        if not any(m.called(name) for m in meshes):
            raise InputError("no such mesh in the file", file=file, field=field, value=name, mend=f"name {_listed(meshes)}")
    return np.array([any(m.called(name) for name in wanted) for m in meshes])


def one_object(file: Path, field: str, meshes: Sequence[NamedMesh]) -> None:
    """Raise an InputError, which lists the objects, where meshes belong to several of them and none was asked for."""
    if len({m.owner for m in meshes}) > 1:
        raise InputError(
            "one object expected, or the names of those that are meant", file=file, field=field,
            value=f"{len({m.owner for m in meshes})} objects", mend=f"name {_listed(meshes)}",
        )  # fmt: skip


def _listed(meshes: Sequence[NamedMesh]) -> str:
    """Return the objects with their vertices, and the materials of those that have several."""
    objects: dict[int, list[NamedMesh]] = {}
    for m in meshes:
        objects.setdefault(m.owner, []).append(m)
    texts = []
    for own in list(objects.values())[:LISTED]:
        name = own[0].name or next(iter(own[0].others), "a mesh without a name")
        materials = dict.fromkeys(m.material for m in own if m.material and m.material != name)
        more = f"; materials {', '.join(materials)}" if len(materials) > 1 else ""
        texts.append(f"{name} ({sum(m.vertices for m in own)} vertices{more})")
    return "one or several of " + ", ".join(texts) + (", ..." if len(objects) > LISTED else "")
