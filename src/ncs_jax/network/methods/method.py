"""What a method of animating a garment has to offer, and what all that learn have in common: decoder and skinning weights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from ncs_jax.energies.terms import Terms
from ncs_jax.errors import InputError, required
from ncs_jax.geometry.skinning import Blend
from ncs_jax.network.decoder import Decoder, begun_at, merge
from ncs_jax.scene.descriptors import DESCRIPTORS
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model

__all__ = [
    "Codes",
    "FromCodes",
    "Kept",
    "Method",
    "Offsets",
    "Windows",
    "check_network",
    "decode",
    "descriptor_sizes",
    "for_inference",
    "garment_blend",
    "initial_parameters",
    "static_code_size",
]


class Codes(NamedTuple):
    """z_S, z_D where there is one, and q, how far a garment swings along its vibrations, where it does."""

    static: Array
    dynamic: Array | None = None
    swing: Array | None = None

    def together(self, alpha: float | Array | None = 1.0) -> Array:
        """Return z_S + alpha z_D (15); None leaves z_D out."""
        return self.static if self.dynamic is None or alpha is None else self.static + alpha * self.dynamic

    def swung(self, alpha: float | Array | None = 1.0) -> Array | None:
        """Return alpha q; None leaves it out."""
        return None if self.swing is None or alpha is None else alpha * self.swing


@dataclass(frozen=True)
class Windows:
    """The windows of one optimiser step, within its trace.

    ends: last frames (batch,). others: which window of the whole batch moves an augmented one (batch,). number: each window's
    place in the whole batch. augmented: so many of the whole batch, the first ones, are moved by another window (motion
    augmentation). length: frames that a window looks back at. history: frames that inertia needs, 3, or 1 without it.
    axis: of the devices that share the batch, None on one. still: from this place on, nothing moves a window.
    """

    ends: Int[Array, "batch"]
    others: Int[Array, "batch"]
    number: Int[Array, "batch"]
    augmented: int
    length: int
    history: int
    axis: str | None = None
    still: int | None = None

    @property
    def own(self) -> Array:
        """Return which windows move by themselves."""
        return self.number >= self.augmented


class Kept(NamedTuple):
    """What a step knows of its windows beside what it differentiates."""

    codes: Array  # z of the last `history` frames (history, batch, code)
    swing: Array | None = None  # q of the last frames (batch, modes)
    force: Array | None = None  # what the garment opposes to it (batch, modes), J


class Offsets(NamedTuple):
    """What a step differentiates, in unposed space, m."""

    frames: list[Array]  # (verts, 3, batch) of each frame, the last first
    extra: Array | None = None  # (verts, 3, batch) that the method's coupling reads


@runtime_checkable
class Method(Protocol):
    """Networks that give codes to the decoder: a frozen dataclass, with its parameters apart.

    What sets methods apart is how they begin, what a frame does to what they carry, and which energy trains them: `init`,
    `step` and `loss`. Energies, kinematics, decoder, training loop and evaluation are the same for all.

    `track.static` and `track.dynamic` are the descriptors of all frames of the motions, laid end to end: (frames, joints,
    numbers), of the sizes that `descriptor_sizes` gives. `track.start` (frames,) is the first frame of each one's motion. A
    class of one's own inherits from `FromCodes` what it does not change; `notebooks/own_network.ipynb` has one of 30 lines, and
    `network.methods.pbns` another.
    """

    @property
    def decoder(self) -> nn.Module:
        """Return what makes offsets of codes: a Flax module, such as the package's own `network.decoder.Decoder`.

        It is called with codes (*poses, code) and the garment's smooth modes (verts, modes), and returns offsets
        (verts, 3, *poses) in unposed space, m.
        """

    @property
    def learn_weights(self) -> bool:
        """Return whether the skinning weights are trained too."""

    @property
    def state(self) -> int:
        """Return how many numbers are carried from frame to frame."""

    @property
    def controlled(self) -> bool:
        """Return whether alpha scales anything."""

    @property
    def refreshes(self) -> bool:
        """Return whether `refresh` changes anything; where it is False, nobody compiles or calls it."""

    @property
    def still(self) -> float:
        """Return the share of a batch whose windows nothing moves, so that the static part is trained by itself too."""

    def code_size(self, model: Model) -> int:
        """Return how many numbers a code has."""

    def init(self, keys: tuple[Array, Array], model: Model) -> dict:
        """Return fresh parameters of all but the decoder."""

    def step(
        self, params: dict, model: Model, state: Array, static: Array, dynamic: Array | None, matrices: Array
    ) -> tuple[Array, Codes]:
        """Return the state after a frame and its codes, from descriptors and joint transforms; of any number of characters.

        Args:
            state: (*characters, state). static, dynamic: (*characters, joints, numbers); dynamic is None where `state` is 0.
            matrices: (*characters, all joints, 3, 4).
        """

    def loss(self, terms: Terms) -> Terms:
        """Return those of a scene's terms that train it, and whether inertia's target carries a gradient."""

    def offsets(self, params: dict, model: Model, track: MotionFeatures, windows: Windows) -> tuple[Offsets, Kept]:
        """Return what one step of training differentiates, and what it keeps constant; see `FromCodes`."""

    def coupling(self, model: Model, extra: Array, kept: Kept) -> tuple[dict[str, Array], Array]:
        """Return energies (batch,) in J beyond the scene's terms, by name, and their gradient by the extra array, N."""

    def refresh(self, params: dict, model: Model, features: MotionFeatures) -> MotionFeatures:
        """Return the motions with what the network, as it is now, tells them. Training calls this now and then."""

    def codes(self, params: dict, model: Model, track: MotionFeatures) -> Codes:
        """Return the codes of every frame (frames, code) of one motion, from rest at its start."""

    def windows(self, params: dict, track: MotionFeatures, ends: Int[Array, "batch"], length: int, last: int) -> Codes:
        """Return the codes (last, batch, code) of the `last` frames of windows of `length` frames that end at `ends`.

        A window that would begin before its motion, at `track.start[ends]`, stands in that frame until then.
        """


def descriptor_sizes(model: Model) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the shapes (joints, numbers) of a frame's static and dynamic descriptors."""
    joints, numbers = len(model.inputs), DESCRIPTORS[model.descriptor]
    return (joints, numbers + 3), (joints, numbers + 6)


def static_code_size(encoder: nn.Module, model: Model) -> int:
    """Return how many numbers a static encoder makes of a frame's descriptors; nothing is computed.

    Raises:
        InputError: it does not make (*frames, code) of (*frames, joints, numbers).
    """
    given = jax.ShapeDtypeStruct((2, 3, *descriptor_sizes(model)[0]), model.basis.dtype)
    code = jax.eval_shape(lambda x: encoder.init_with_output(jax.random.PRNGKey(0), x)[0], given)
    shape = getattr(code, "shape", None)
    if shape is None or shape[:-1] != (2, 3):
        what = f"codes (*frames, code) of descriptors (*frames, joints, numbers) expected, here (2, 3, code) of {given.shape}"
        raise InputError(what, field="static encoder", value=f"shape {shape}", mend="leave the leading axes as they are")
    return shape[-1]


def check_network(network: Any, model: Model) -> None:
    """Trace one frame of a network of one's own: what does not fit is found before anything is compiled.

    Raises:
        InputError: a part lacks what the method reads, or gives another shape than expected.
    """
    key, (static, dynamic) = jax.random.PRNGKey(0), descriptor_sizes(model)

    def frame(static, dynamic, matrices):
        params = initial_parameters(network, key, model)
        state = jnp.zeros((2, network.state), model.basis.dtype)
        _, codes = network.step(params, model, state, static, dynamic if network.state else None, matrices)
        if codes.dynamic is not None and codes.dynamic.shape != codes.static.shape:
            what, found = (
                f"codes as long as the static encoder's, {codes.static.shape[-1]} numbers, expected",
                codes.dynamic.shape,
            )
            raise InputError(what, field="dynamic encoder", value=f"shape {found}", mend="z = z_S + alpha z_D adds them")
        return decode(network, params, model, codes.together())

    shapes = (2, *static), (2, *dynamic), (2, len(model.skeleton.parents), 3, 4)
    try:
        jax.eval_shape(frame, *(jax.ShapeDtypeStruct(shape, model.basis.dtype) for shape in shapes))
    except AttributeError as fault:
        mend = "see ncs_jax.network.methods.method.Method, and notebooks/own_network.ipynb for encoders"
        raise InputError(f"what the method reads is missing: {fault}", field="network", mend=mend) from fault


def initial_parameters(network: Method, key: Array, model: Model) -> dict:
    """Return fresh parameters, a plain pytree of arrays.

    Where the garment's drape is known, it begins there: its folds fall as a simulation's do. A training that begins at rest has
    others, as folds may fall in many ways for the same energy, or has none for long, as they cost so little.
    """
    first, second, third = jax.random.split(key, 3)
    code = jnp.zeros(network.code_size(model), model.basis.dtype)
    params = network.init((first, second), model)
    params["decoder"] = network.decoder.init(third, code, model.basis)["params"]
    drape = None if model.vibrations is None else model.vibrations.drape
    if drape is not None and isinstance(network.decoder, Decoder):
        params["decoder"] = begun_at(network.decoder, params["decoder"], drape)
    if network.learn_weights:
        params["blend"] = jnp.zeros_like(model.blend.weights)
    return params


def garment_blend(network: Method, params: dict, model: Model) -> Blend:
    """Return the garment's skinning weights: given, or scaled by learned factors w exp(s) / sum, which keep zeros zero."""
    if not network.learn_weights:
        return model.blend
    scaled = model.blend.weights * jnp.exp(params["blend"])
    return Blend(scaled / jnp.sum(scaled, axis=-1, keepdims=True), model.blend.joints)


def decode(
    network: Method,
    params: dict,
    model: Model,
    code: Float[Array, "*frames code"],
    swing: Float[Array, "*frames modes"] | None = None,
) -> Float[Array, "verts 3 *frames"]:
    """Return offsets in unposed space, m: those of the code, with a run of an earlier version those of a swing beside them."""
    offsets = jnp.asarray(network.decoder.apply({"params": params["decoder"]}, code, model.basis))
    if offsets.shape != (expected := (len(model.basis), 3, *code.shape[:-1])):
        raise InputError(f"offsets {expected} expected: vertices, axes, poses", field="decoder", value=f"shape {offsets.shape}")
    if swing is None or (vibrations := required(model.vibrations, "model.vibrations")).slope is not None:
        return offsets
    return offsets + jnp.tensordot(vibrations.directions, swing, (-1, -1), precision="highest")


class FromCodes:
    """What methods share that train on nothing but the codes of their windows: nothing couples, and nothing is refreshed."""

    refreshes, still = False, 0.0

    def offsets(self: Method, params: dict, model: Model, track: MotionFeatures, windows: Windows) -> tuple[Offsets, Kept]:
        """Return the offsets of windows whose codes come from `self.windows`: those that the loss differentiates.

        With motion augmentation the first windows take another one's dynamic code on their static code, both constants.
        """
        history = windows.history
        z_static, z_dynamic, _ = self.windows(params, track, windows.ends, max(windows.length, history), history)
        augmented = windows.augmented
        if z_dynamic is None:
            z = z_static
        elif not augmented:
            z = z_static + z_dynamic
        elif windows.axis is not None:  # any number of this device's windows are such, and the others' codes may be elsewhere
            everyone = lax.all_gather(lax.stop_gradient(z_dynamic), windows.axis, axis=1, tiled=True)
            mixed = lax.stop_gradient(z_static) + everyone[:, windows.others]
            z = jnp.where(windows.own[:, None], z_static + z_dynamic, mixed)
        else:
            others = windows.others[:augmented]
            mixed = lax.stop_gradient(z_static[:, :augmented]) + lax.stop_gradient(z_dynamic[:, others])
            z = jnp.concatenate([mixed, (z_static + z_dynamic)[:, augmented:]], axis=1)
        if not model.terms.through_time:
            return Offsets([decode(self, params, model, z[-1])]), Kept(z)
        every = decode(self, params, model, z)
        return Offsets([every[:, :, k] for k in (2, 1, 0)]), Kept(z)

    def coupling(self, model: Model, extra: Array, kept: Kept) -> tuple[dict[str, Array], Array]:
        """Return no energy: the offsets have no extra array."""
        return {}, jnp.zeros_like(extra)

    def refresh(self, params: dict, model: Model, features: MotionFeatures) -> MotionFeatures:
        """Return the motions as they are."""
        return features


def for_inference(network: Any, params: dict, model: Model) -> tuple[Any, dict]:
    """Return the same network with the decoder's two linear maps made one; a decoder of one's own stays as it is."""
    if not isinstance(network.decoder, Decoder):
        return network, params
    decoder, decoder_params = merge(network.decoder, params["decoder"], model.basis)
    return replace(network, decoder=decoder), {**params, "decoder": decoder_params}
