"""Where a training begins: anew, where a run stopped, or with the weights of another run of the same garment."""

from __future__ import annotations

import functools
import json
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax import io
from ncs_jax.energies.terms import OwnTerm
from ncs_jax.errors import InputError, InputWarning
from ncs_jax.network.methods.choose import network_from
from ncs_jax.prepare.build import SWING, Assembly, check_terms, vibrations_of
from ncs_jax.prepare.prepared import Prepared
from ncs_jax.prepare.setting import read_worn, set_up
from ncs_jax.prepare.skinning_weights import used_joints
from ncs_jax.runs.checkpoint import Checkpoints, check_writable, read_prepared, read_run
from ncs_jax.runs.run import NetworkMaker, Run, check_own, load_run
from ncs_jax.scene.spec import PRESETS, NetworkSpec, Scene, scene_from
from ncs_jax.training.step import initial_state

__all__ = ["assemble_run", "facts_of_run", "resumed_scene", "unread_joints"]

FREE = ("damping",)  # fields of [network] that no weight depends on
MODELLED = ("body", "garment", "motion", "physics", "network")  # tables of a scene that a run which is resumed keeps


def assemble_run(
    scene: Scene,
    facts: dict | None,
    out: Path | None,
    start: Run | str | Path | None,
    network: NetworkMaker | None,
    make_ready: Callable[..., Assembly],
) -> tuple[Assembly, dict | None]:
    """Make the scene of a run ready; return it, and the weights that it begins with where it begins with another run's.

    Args:
        scene: the run's. facts: of the run that is resumed, if any, in the folder `out`. start: a run to begin from, if any.
        network: one's own, if any. make_ready: `run.assemble` but for the scene.

    Raises:
        InputError: a file is unusable, or terms, network or the run to begin from do not fit.
    """
    if start is not None:
        return _assemble_started(start, scene, network, functools.partial(make_ready, ahead=None))
    kept = None
    if facts is not None and out is not None and (out / "prepared.npz").exists():
        kept = read_prepared(out)
        set_up(replace(scene, garment=replace(scene.garment, over=())), prepared=kept)  # refuses files that were changed since
    assembly = make_ready(scene)
    if kept is not None and out is not None:  # what it has learned is not found anew
        _check_prepared(out, kept, assembly.prepared)
        assembly = _with_fields_of(kept, assembly)
    return assembly, None


# --- where a run stopped ----------------------------------------------------------------------------------------------------


def facts_of_run(out: Path | None, resume: bool, terms: Sequence[OwnTerm], network: NetworkMaker | None) -> dict | None:
    """Return what run.json says of the run to resume, None for a new run.

    Raises:
        InputError: there is no run to resume, there is one that is not to be resumed or has other terms or another network of
            its own, or the folder cannot be written.
    """
    if out is not None:
        check_writable(out)
    if out is None or not (out / "run.json").exists():
        if resume:
            raise InputError("no run to resume", file=out, mend="leave --resume out to begin one")
        return None
    if not resume:
        raise InputError("a new folder expected", file=out, value="a run", mend="add --resume, or choose another --out")
    facts = read_run(out)
    if adapted := facts.get("adapted"):  # its scene has other motions than what its network was made for
        motions = " ".join(f"--motion {name}" for name in adapted["motions"])
        again = f"`ncs animate {facts['start']} {motions} --adapt SECONDS --adapted {out} --out FILE` goes on with it"
        raise InputError(
            "a run that was not adapted expected", file=out, value=f"one adapted for {adapted['seconds']:g} s",
            mend=f"{again}, with more of them; a new run begins from its weights with --from {out}",
        )  # fmt: skip
    check_own(facts, out, terms, network)
    return facts


def _check_swing(kept: Prepared, run: str) -> None:
    """Raise an InputError where a run has the swing of an earlier version, which is trained no more."""
    if kept.vibrations.size and not kept.slope.size:
        mend = "train anew into a new folder; what this run has learned can still be animated"
        raise InputError("a swing of this version expected", file=run, field="prepared.npz: slope", mend=mend)


def resumed_scene(facts: dict, out: Path, scene: Scene | None, seed: int | None, steps: int | None) -> Scene:
    """Return the scene of a run that is resumed; warn where the one given, if any, is to be trained otherwise.

    Raises:
        InputError: the scene given has another model, the seed is another one, the run has more steps than `steps`, or it began
            from a run and has no checkpoint.
    """
    if seed is not None and seed != facts["seed"]:
        raise InputError("a run keeps its seed", file=out, field="--seed", value=seed, mend="leave it out, or begin a new run")
    done = Checkpoints(out).latest()
    if done is None and facts.get("start"):
        raise InputError("no checkpoint there yet", file=out, mend="delete this folder and begin anew")
    if steps is not None and steps < (done or 0):
        mend = "give more, or begin a new run"
        raise InputError(
            f"at least the {done} steps that the run has expected", file=out, field="--steps", value=steps, mend=mend
        )
    kept = scene_from(facts["scene"], source=str(out / "run.json"))
    if (out / "prepared.npz").exists():  # else it was killed before that was written
        _check_swing(read_prepared(out), str(out))
    if scene is not None:
        _check_same_scene(facts, out, kept, scene)
    return kept


def _check_prepared(out: Path, kept: Prepared, found: Prepared) -> None:
    """Raise an InputError where what a run keeps of its garment is of another size than what its scene gives now."""
    for name, field in (("basis", "network.modes, or garment.file"), ("vibrations", "network.cell, or network.vibrations")):
        shapes = [getattr(prepared, name).shape for prepared in (kept, found)]
        apart = shapes[0] != shapes[1] if name == "basis" else (0 in shapes[0]) != (0 in shapes[1])
        if apart:
            raise InputError(
                f"the garment that was trained expected, with {name} of shape {shapes[0]}", file=out / "run.json",
                field=f"scene: {field}", value=shapes[1],
                mend="the scene, or a file that it names, was changed since: change it back, or train anew into another folder",
            )  # fmt: skip


def _check_same_scene(facts: dict, out: Path, kept: Scene, scene: Scene) -> None:
    """Refuse a scene of another model than a run's; warn where only its training or simulation differs: neither is taken."""
    chosen = {"body.joints"} if facts.get("start") else set()  # by `_assemble_started`
    chosen |= {"network.cell"} if scene.network.cell == "auto" else set()
    tables = kept.to_dict(), scene.to_dict()
    by_preset = [{table: tables[1][table] | values for table, values in preset.items()} for preset in ({}, *_no_defaults())]
    each = [[d for d in _differences(tables[0], tables[1] | preset) if d[0] not in chosen] for preset in by_preset]
    other = min(each, key=len)  # of a run that began with --preset, which is not given again
    lists = {"motion.files", "motion.validation"} if scene.motion.found or scene.motion.broken == "skip" else set()
    if refused := [each for each in other if each[0].split(".")[0] in MODELLED and each[0] not in lists]:
        (name, before, now), *more = refused
        raise InputError(
            f"the scene of {out} expected, where it is {json.dumps(before)}", file=scene.source, field=name, value=now,
            mend=f"leave the scene out to go on with the run's, or begin a new run with its weights: --from {out}"
            + (f"; other too: {', '.join(each[0] for each in more)}" if more else ""),
        )  # fmt: skip
    if other:
        what = f"{out} keeps the scene that it began with; given otherwise now, and not taken: {', '.join(d[0] for d in other)}"
        warnings.warn(f"{what}; a new run can begin from its weights: --from {out}", category=InputWarning, stacklevel=4)


def _no_defaults() -> list[dict[str, dict]]:
    """Return the presets without what is a field's default, which would hide that a scene has something of its own there."""
    plain = Scene().to_dict()

    def told(table: str, values: dict) -> dict:
        return {name: value for name, value in values.items() if value != plain[table][name]}

    return [{table: told(table, values) for table, values in preset.items()} for preset in PRESETS.values()]


def _differences(kept: dict, given: dict, where: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the name and both values of every field that two scenes have different values of."""
    for key, value in kept.items():
        now = given[key]
        if isinstance(value, dict) and value.keys() == now.keys():
            yield from _differences(value, now, f"{where}{key}.")
        elif json.dumps(value) != json.dumps(now):  # a list and a tuple are one there
            yield f"{where}{key}", value, now


# --- the weights of another run ---------------------------------------------------------------------------------------------


def _assemble_started(
    start: Run | str | Path,
    scene: Scene,
    network: NetworkMaker | None,
    make_ready: Callable[..., Assembly],
) -> tuple[Assembly, dict]:
    """Make a scene ready for a network that another run has trained; return it and the weights.

    The network goes on to read the joints that it has read, whatever moves in the scene's own motions. Its vibrations stay
    where garment and physics are the same; else they are found anew, and what was learned of them is learned again.

    Raises:
        InputError: the run's garment has other triangles, or its network other sizes or joints.
    """
    run = start if isinstance(start, Run) else load_run(start, network=network)
    name = "a run" if isinstance(start, Run) else str(start)
    before = run.assembly
    if run.lacking:
        told = f"{name} was trained with terms of one's own, {', '.join(run.lacking)}, and this run is trained without"
        mend = "in Python, give terms=[...] and start=load_run(RUN, terms=[...])"
        warnings.warn(f"{told}; {mend}", category=InputWarning, stacklevel=4)
    _check_swing(before.prepared, name)
    if scene.network.cell == "auto":
        scene = replace(scene, network=replace(scene.network, cell=before.scene.network.cell))
    _check_garment(name, before, scene)
    if network is None:
        _check_network(name, before.scene.network, scene)
    if not scene.body.joints:
        _check_body(name, before, scene)
        scene = replace(scene, body=replace(scene.body, joints=_joints(before)))
    tables = [each.to_dict() for each in (before.scene, scene)]  # with whole paths
    same = all(tables[0][name] == tables[1][name] for name in ("physics", "garment"))
    swings = same and network is None and before.model.vibrations is not None
    # Its vibrations are known: made ready as one that does not swing, no minute is spent on looking for them.
    assembly = make_ready(replace(scene, network=replace(scene.network, cell="gated")) if swings else scene)
    if swings:
        check_terms(assembly.model, assembly.model.terms.own, assembly.track, past=False)
        assembly = replace(_swinging(before.prepared, assembly), scene=scene)
        assembly = replace(assembly, network=network_from(scene, assembly.model))
    like = jax.eval_shape(lambda: initial_state(assembly.model, assembly.network, 0)).params
    _check_shapes(name, run.params, like, scene)
    if same:
        assembly = _with_fields_of(before.prepared, assembly)
    if unread := unread_joints(assembly):
        told = f"the network of {name} does not read joints that turn in the motions: {', '.join(unread)}"
        warnings.warn(f"{told}; what they do to the garment is not learned", category=InputWarning, stacklevel=4)
    return assembly, jax.tree.map(jnp.array, run.params)  # copies: training uses up what it is given


def _check_garment(name: str, before: Assembly, scene: Scene) -> None:
    """Raise an InputError where a scene has a garment of other triangles than a run: before anything is made ready."""
    given, (kept, new) = read_worn(scene), (", ".join((s.garment.file, *s.garment.layers)) for s in (before.scene, scene))
    if not np.array_equal(before.garment.faces, given.faces):
        kept = f"{kept} with {len(before.garment.faces)} triangles"
        raise InputError(
            f"the garment of {name} expected, {kept}, which its weights are for", file=scene.source, field="garment.file",
            value=f"{new}, {len(given.faces)} triangles", mend="train this garment anew, without --from",
        )  # fmt: skip


def _check_body(name: str, before: Assembly, scene: Scene) -> None:
    """Raise an InputError where a scene has a body without the joints that the network of a run reads."""
    kept, given = (str(a.path(a.body.file).resolve()) for a in (before.scene, scene))
    if before.body is None or kept == given or (scene.body.file not in ("", "none") and scene.moves_by_itself):
        return
    lacking, joints = list(_joints(before)), []
    if scene.body.file not in ("", "none"):
        body = io.read_body(scene.path(scene.body.file), part=scene.body.meshes, correctives=False)
        joints = [*body.joint_names, *map(str, range(len(body.parents)))]
    lacking = [joint for joint in lacking if joint not in joints]
    if lacking:
        more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        raise InputError(
            f"the body of {name} expected, {before.scene.body.file}, whose joints its network reads", file=scene.source,
            field="body.file", value=f"{scene.body.file}, without joint {lacking[0]}{more}",
            mend="train on this body anew, without --from",
        )  # fmt: skip


def _check_network(name: str, before: NetworkSpec, scene: Scene) -> None:
    """Raise an InputError where a scene asks for another network than a run has."""
    for field in fields(NetworkSpec):
        expected, found = getattr(before, field.name), getattr(scene.network, field.name)
        if field.name not in FREE and found != expected:
            raise InputError(
                f"the network of {name} expected, {expected}", file=scene.source, field=f"network.{field.name}", value=found,
                mend=f"write {field.name} = {json.dumps(expected)} under [network]",
            )  # fmt: skip


def _joints(assembly: Assembly) -> tuple[str, ...]:
    """Return the joints that a network reads as the field `body.joints` has them: names, or numbers where they have none."""
    names = assembly.body.joint_names if assembly.body is not None else ()
    inputs = assembly.prepared.inputs.tolist()
    return tuple(names[i] if len(set(names)) > i and names.count(names[i]) == 1 else str(i) for i in inputs)


def _with_fields_of(before: Prepared, assembly: Assembly) -> Assembly:
    """Return an assembly with the smooth modes and the vibrations that the weights of another one were trained with."""
    model, prepared = assembly.model, replace(assembly.prepared, basis=before.basis)
    model = replace(model, basis=jnp.asarray(before.basis, model.basis.dtype))
    assembly = replace(assembly, model=model, prepared=prepared)
    return assembly if model.vibrations is None else _swinging(before, assembly)


def _swinging(before: Prepared, assembly: Assembly) -> Assembly:
    """Return an assembly with the vibrations of another one."""
    prepared = replace(assembly.prepared, **{name: getattr(before, name) for name in SWING})
    model = replace(assembly.model, vibrations=vibrations_of(prepared, assembly.model.basis.dtype))
    return replace(assembly, model=model, prepared=prepared)


def _check_shapes(name: str, params: dict, like: dict, scene: Scene) -> None:
    """Raise an InputError that names the first array of a network that a run has not, or has of another shape."""
    shapes = [{jax.tree_util.keystr(at): a.shape for at, a in jax.tree.leaves_with_path(tree)} for tree in (params, like)]
    for at in (*shapes[1], *shapes[0]):
        before, expected = (shape.get(at) for shape in shapes)
        if before != expected:
            raise InputError(
                f"weights of the shapes of {name} expected: {at} has {before or 'none'} there", file=scene.source,
                field="network", value=expected or "none",
                mend="give the same garment, body, joints and network; one of your own is given in Python, network=...",
            )  # fmt: skip


def unread_joints(assembly: Assembly) -> list[str]:
    """Return the names of joints that carry the garment, turn in the training motions, and are not read by the network."""
    body, prepared = assembly.body, assembly.prepared
    if body is None:
        return []
    records = [assembly.motions[name] for name in assembly.scene.motion.files]
    turning = np.any([np.any(r.poses != r.poses[:1], axis=(0, 2)) for r in records], axis=0)
    carrying = used_joints(body.parents.tolist(), np.concatenate([prepared.weights, body.weights[prepared.part]]))
    found = [j for j in carrying if records and turning[j] and body.parents[j] >= 0 and j not in prepared.inputs]
    return [body.joint_names[j] if body.joint_names else str(j) for j in found]
