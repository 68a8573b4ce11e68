"""What the energies take: which terms a scene has, its material, its garment, and what one step brings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import jax
from jaxtyping import Array, Float, Int

from ncs_jax.energies import baraff_witkin as _baraff_witkin
from ncs_jax.energies import neo_hookean as _neo_hookean
from ncs_jax.energies import stvk as _stvk
from ncs_jax.energies.baraff_witkin import baraff_witkin
from ncs_jax.energies.contact.layers import Upper
from ncs_jax.energies.contact.pairs import Groups
from ncs_jax.energies.mass_spring import mass_spring
from ncs_jax.energies.neo_hookean import neo_hookean
from ncs_jax.energies.stvk import stvk
from ncs_jax.geometry.mesh import Mesh

__all__ = ["DENSITIES", "MEASURED", "MEMBRANES", "NAMES", "Garment", "Material", "OwnTerm", "StepInputs", "Terms"]


MEMBRANES: dict[str, tuple[Callable[..., Array], tuple[str, ...]]] = {
    "stvk": (stvk, ("lam", "mu")),
    "neo_hookean": (neo_hookean, ("lam", "mu")),
    "baraff_witkin": (baraff_witkin, ("stretch", "shear")),
    "mass_spring": (mass_spring, ("stiffness",)),
}
DENSITIES: dict[str, Callable[..., Array]] = {  # energy per rest area of the membranes that are made of faces
    "stvk": _stvk.density,
    "neo_hookean": _neo_hookean.density,
    "baraff_witkin": _baraff_witkin.density,
}


NAMES = (
    "membrane",
    "bending",
    "collision",
    "friction",
    "gravity",
    "pinning",
    "external",
    "inertia",
    "self_contact",
    "layers",
    "hold",
    "untangling",
    "total",
)
# What a log and an evaluation write beside the energies: a term of this name would be lost among them.
MEASURED = (
    *("step", "strain", "moved", "dropped", "seconds"),
    *("strain_mean", "strain_p99", "shear_mean", "hinge_mean", "penetrating", "depth_max"),
    *("middle_penetrating", "middle_depth_max", "centre_penetrating", "centre_depth_max"),
    *("layer_penetrating", "layer_depth_max"),
    *("within_1mm", "self_intersecting", "body_intersecting", "skin_pixels", "skin_share"),
    *("out_of_balance", "gradient_norm", "outside", "speed", "lag", "settling", "overshoot"),
    *("gain", "dynamic_share", "stopped_share", "hem_correlation", "distance"),
    *("static_distance", "dynamic_correlation", "dynamic_factor"),
)


@runtime_checkable
class OwnTerm(Protocol):
    """A term of one's own: a pure function `term(x, step)` that returns an energy in J and is differentiable by x.

    x: positions (verts, 3) in m. step: the model's `StepInputs` of one pose. It is known by its `__name__`. Where the network
    has no past while it trains (a swing's loss is static, and so is PBNS's), `step.previous` and `step.before` are None: a term
    of the velocity, such as drag, needs `network.cell = "gated"`.
    """

    __name__: str

    def __call__(self, x: Float[Array, "verts 3"], step: StepInputs) -> Float[Array, ""]:
        """Return the energy, J."""


@dataclass(frozen=True)
class Terms:
    """Which terms a scene has. What is not named here is not traced."""

    membrane: str | None = "stvk"
    bending: bool = True
    collision: str | None = "plane"  # "plane", "smooth", "triangle" or None
    exact: bool = True  # exact search; otherwise candidates alone
    friction: bool = False
    gravity: bool = True
    inertia: bool = True
    through_time: bool = False  # inertia's target carries a gradient
    pinning: bool = False
    self_contact: bool = False
    layers: str | None = None  # contact between garments worn together: "plane", "triangle" or None
    own: tuple[OwnTerm, ...] = ()  # terms of one's own, each a pure function of positions and step inputs

    def __post_init__(self):
        """Check that every own term has a name of its own.

        Raises:
            ValueError: it has not.
        """
        taken = {*NAMES, *MEASURED}
        for term in self.own:
            name = getattr(term, "__name__", "")
            if not name.isidentifier() or name in taken or name.startswith("validation_"):
                raise ValueError(f"a term of one's own needs a __name__ that no other term or measure has, not {name!r}")
            taken.add(name)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Material:
    """The numbers of the energies, in SI units; any of them may be differentiated or batched.

    density: kg/m^2. membrane: in the order of `MEMBRANES`: Lame's lam and mu, N/m, for "stvk" and "neo_hookean"; stretch and
    shear, N/m, for "baraff_witkin"; stiffness, N/m, for "mass_spring". bending: N m. collision: J/m^2 a vertex, at `thickness`
    (m) from the body. friction: its coefficient. pinning: N/m. gravity: (3,), m/s^2. self_contact: J/m^2 a pair, at
    `self_thickness` (m).
    """

    density: Float[Array, ""]  # kg/m^2
    membrane: tuple[Float[Array, ""], ...]  # in the order of MEMBRANES
    bending: Float[Array, ""]  # N m
    collision: Float[Array, ""]  # J/m^2 a vertex
    thickness: Float[Array, ""]  # m
    friction: Float[Array, ""]  # its coefficient
    pinning: Float[Array, ""]  # N/m
    gravity: Float[Array, 3]  # m/s^2
    self_contact: Float[Array, ""] | None = None  # J/m^2 a pair
    self_thickness: Float[Array, ""] | None = None  # m


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Garment:
    """What a garment is to the energies: its mesh, which vertices are pinned, its groups where it looks for itself.

    uppers: of garments worn together, those that are over others, from the skin outwards.
    """

    mesh: Mesh
    pins: Int[Array, "pins"]
    groups: Groups | None = None
    uppers: tuple[Upper, ...] = ()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StepInputs:
    """What one step brings to the energies; `None` where no term asks for it.

    `frame_inputs` makes it for a frame of a motion; `StepInputs(dt, previous, before)` is enough without a body.
    dt: s. previous, before: the garment one and two steps ago, m. body: posed, m, with its normals. vertex_transforms: what
    skinning does to every vertex. advected: where the body alone would carry the garment, m. lagged_normal_force: of contact
    there, N. force: external, N. moving: what inertia counts, 0 for a pose without a past.

    With several poses beside each other every array has them as its last axis.
    """

    dt: float | Float[Array, ""] = field(default=1 / 30)  # s
    previous: Float[Array, "verts 3 *poses"] | None = None  # x_{t-1}, m
    before: Float[Array, "verts 3 *poses"] | None = None  # x_{t-2}, m
    body: Float[Array, "body 3 *poses"] | None = None  # posed, m
    vertex_transforms: Float[Array, "verts 3 4 *poses"] | None = None  # what skinning does to every vertex of the garment
    advected: Float[Array, "verts 3 *poses"] | None = None  # where the body alone would carry x_{t-1}, m
    lagged_normal_force: Float[Array, "verts 3 *poses"] | None = None  # of contact there, `total.contact_force`, N
    normals: Float[Array, "body 3 *poses"] | None = None  # of the body's vertices, where they are known already
    force: Float[Array, "verts 3 *poses"] | None = None  # external, N
    moving: Float[Array, "*poses"] | None = None  # what inertia and friction count: 0 for a pose that has no past; None: 1
