"""Meshes of glTF that KHR_draco_mesh_compression packs, unpacked by Google's decoder (the package DracoPy)."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from ncs_jax.io.character.gltf import COMPONENTS, WIDTHS, Gltf

__all__ = ["DRACO", "unpack_draco"]

DRACO = "KHR_draco_mesh_compression"


def unpack_draco(gltf: Gltf, primitive: dict, where: str) -> None:
    """Put a packed primitive's attributes and corners in the place of its accessors; one that is not packed stays as it is.

    Raises:
        InputError: DracoPy is not installed, or the data are damaged or do not fit the accessors.
    """
    packed = gltf.object("extensions", primitive, where).get(DRACO)
    if packed is None:
        return
    if find_spec("DracoPy") is None:
        raise gltf.wrong(
            f"the package DracoPy is needed for {DRACO}", where, DRACO,
            "pip install 'ncs-jax[draco]', or export without mesh compression",
        )  # fmt: skip
    import DracoPy

    if not isinstance(packed, dict):
        raise gltf.wrong("an object expected", f"{where} {DRACO}", packed)
    views, attributes = gltf.objects("bufferViews"), gltf.object("attributes", primitive, where)
    view = views[gltf.whole("bufferView", packed, f"{where} {DRACO} bufferView", len(views))]
    length = gltf.whole("byteLength", view, f"{where} {DRACO} byteLength", 2**40)
    data = gltf.rows(packed, f"{where} {DRACO}", length, 1, np.dtype("u1")).tobytes()
    try:
        mesh = DracoPy.decode(data)
        corners = np.asarray(mesh.faces).reshape(-1, 1)
    except Exception as error:
        raise gltf.wrong(f"data of {DRACO} expected: {error}", where, "damaged", "export without mesh compression") from None
    numbers = gltf.object("attributes", packed, f"{where} {DRACO}")
    found = {}
    for name in numbers:
        if name in attributes:
            one = mesh.get_attribute_by_unique_id(gltf.whole(name, numbers, f"{where} {DRACO} {name}", 2**32))
            found[name, gltf.whole(name, attributes, f"{where} {name}", len(gltf.objects("accessors")))] = one["data"]
    if "indices" in primitive:
        found["indices", gltf.whole("indices", primitive, f"{where} indices", len(gltf.objects("accessors")))] = corners
    for (name, index), rows in found.items():
        _put(gltf, index, np.asarray(rows), f"{where} {name}")


def _put(gltf: Gltf, index: int, rows: np.ndarray, where: str) -> None:
    """Take unpacked rows (count, width) as those of an accessor, after a check of their number, width and type."""
    one = gltf.objects("accessors")[index]
    kind, component = gltf.text("type", one, where), one.get("componentType")
    if kind not in WIDTHS or component not in COMPONENTS or rows.ndim != 2 or rows.shape[1] != WIDTHS[kind]:
        raise gltf.wrong(f"{kind} of type {component} expected", where, rows.shape)
    if gltf.whole("count", one, f"{where} count", 2**32) != len(rows):
        raise gltf.wrong(f"{one['count']} rows expected", where, len(rows))
    dtype = np.dtype(COMPONENTS[component])
    gltf.keep(index, rows.astype(dtype), where, one.get("normalized", False) is True)
