"""Read and write run folders: Orbax checkpoints, and the JSON that rebuilds everything else.

    RUN/run.json                the scene, the steps planned, the seed, the versions
    RUN/prepared.npz            what was computed from the scene's files: skinning weights, touchable part, modes
    RUN/prepared-STEP.npz       the same with what training found of the garment at a step: its stiffness by pose
    RUN/trained.npz             what poses and speeds it was trained on, and how much the cloth is strained there
    RUN/checkpoints/STEP/       Orbax: parameters, optimiser, counters; the last two are kept
    RUN/log.csv                 one row a report

Every write goes to a temporary name first and is renamed when complete, so a kill at any moment leaves the last good one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import gc
import json
import logging
import os
import re
import shutil
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ncs_jax.errors import InputError
from ncs_jax.io.tables.npz import read_npz, write_npz
from ncs_jax.metrics.coverage import TrainedMotion, fault_of
from ncs_jax.prepare.prepared import Prepared
from ncs_jax.scene.model import Model

__all__ = [
    "Checkpoints",
    "check_writable",
    "read_prepared",
    "read_run",
    "read_trained",
    "write_prepared",
    "write_run",
    "write_trained",
]

KEPT = 2  # checkpoints
NAME = "default"  # what Orbax calls the one thing in a checkpoint: so its version 0 did, and each reads what the other wrote
CHANGED = {  # arrays of a network, and what of a scene sets their sizes, what is sure first
    r"static\..*bias": "network.static",
    r"decoder\.layers.*bias": "network.decoder",
    r"decoder\.offsets\.bias": "garment.file",
    r"decoder\.coefficients\.bias": "network.modes",
    r"static\.": "network.descriptor, or body.joints",
    r"dynamic\.": "network.dynamic, joint or cell",
}
TEMPORARY = ".orbax-checkpoint-tmp"


def check_writable(run: Path) -> None:
    """Check, before anything is computed, that a run folder can be made.

    Raises:
        InputError: it cannot.
    """
    there = next(p for p in (run, *run.absolute().parents) if p.exists())
    if not there.is_dir() or not os.access(there, os.W_OK):
        kind = "is not a folder" if not there.is_dir() else "may not be written to"
        raise InputError(f"a folder that can be written expected: {there} {kind}", file=run, mend="choose another --out")


def write_run(run: Path, facts: dict) -> None:
    """Write RUN/run.json atomically.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        temporary = run / "run.json.part"
        temporary.write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
        os.replace(temporary, run / "run.json")
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"a folder that can be written expected: {reason}", file=run, mend="choose another --out") from None


def read_run(run: Path) -> dict:
    """Read RUN/run.json.

    Raises:
        InputError: the folder is not a run.
    """
    path = Path(run) / "run.json"
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError("no run there", file=path, mend="give a folder that ncs train made") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"not a run file: {error}", file=path, mend="train again into a new folder") from None
    if not isinstance(facts, dict) or "scene" not in facts or "steps" not in facts:
        raise InputError("not a run file", file=path, field="scene", mend="train again into a new folder")
    if isinstance(facts["scene"], dict) and isinstance(facts["scene"].get("body"), dict):
        facts["scene"]["body"].setdefault("correctives", False)  # a run of an earlier version was trained without
    return facts


def write_prepared(run: Path, prepared: Prepared, step: int = 0) -> None:
    """Write RUN/prepared.npz atomically, or what training has made of it at a step, RUN/prepared-STEP.npz."""
    temporary = run / "prepared.part.npz"
    np.savez_compressed(temporary, **vars(prepared))
    os.replace(temporary, run / (f"prepared-{step}.npz" if step else "prepared.npz"))


def read_prepared(run: Path) -> Prepared:
    """Read RUN/prepared.npz, or what training had made of it at the newest checkpoint.

    Raises:
        InputError: it is missing or damaged.
    """
    fields = dataclasses.fields(Prepared)
    names = [f.name for f in fields]
    made = {int(p.stem.removeprefix("prepared-")): p for p in Path(run).glob("prepared-*.npz")}
    latest = Checkpoints(Path(run)).latest() if made else None
    path = max((step, p) for step, p in {0: Path(run) / "prepared.npz", **made}.items() if step <= (latest or 0))[1]
    try:
        table = read_npz(path, names.__contains__)
        first = [f.name for f in fields if f.default_factory is dataclasses.MISSING]  # of a run of an earlier version
        return Prepared(**{name: table.array(name) for name in names if name in table or name in first})
    except InputError as error:
        raise InputError(error.expected, file=path, field=error.field, mend="train again into a new folder") from None


def write_trained(run: Path, trained: TrainedMotion) -> None:
    """Write RUN/trained.npz atomically."""
    write_npz(run / "trained.npz", **vars(trained))


def read_trained(run: Path, model: Model) -> TrainedMotion | None:
    """Read RUN/trained.npz; None in a run that has none, as one of an earlier version.

    Raises:
        InputError: it is damaged, or of another garment or body than the run's model.
    """
    path, names = Path(run) / "trained.npz", [f.name for f in dataclasses.fields(TrainedMotion)]
    mend = "delete this file: what it keeps is found again from the motions of the scene"
    if not path.exists():
        return None
    try:
        table = read_npz(path, names.__contains__)
        frames = [name for name in names if name.startswith("frame")]
        later = () if any(name in table for name in frames) else ("strain", *frames)  # than the first versions
        known: dict[str, Any] = {name: table.array(name)[()] for name in names if name in table or name not in later}
    except InputError as error:
        raise InputError(error.expected, file=path, field=error.field, value=error.value, mend=mend) from None
    if fault := fault_of(trained := TrainedMotion(**known), model):
        field, expected, value = fault
        raise InputError(f"{expected} expected", file=path, field=field, value=value, mend=mend)
    return trained


class Checkpoints:
    """The checkpoints of one run, a folder for each, named by its step; the newest `KEPT` are kept.

    Orbax writes each into a temporary folder and renames it when it is whole. Only one process writes, and no other waits.
    """

    def __init__(self, run: Path):
        self._folder = (Path(run) / "checkpoints").absolute()
        self._folder.mkdir(parents=True, exist_ok=True)

    def save(self, step: int, state: Any) -> None:
        """Write the state after `step` steps.

        Raises:
            InputError: the disk is full, or the folder is gone.
        """
        # As NumPy arrays, which belong to no device: any number of devices of any kind can go on with them.
        arrays = jax.tree.map(np.asarray, state)
        try:
            if jax.process_count() > 1:
                self._save_among_hosts(step, arrays)
            else:
                ocp = _orbax()
                with _alone(ocp):
                    ocp.save(self._folder / str(step), arrays, checkpointable_name=NAME)
            self._tidy()
        except OSError as error:
            reason = error.strerror or str(error)
            mend = "make room and go on with --resume; the checkpoint before this one is whole"
            raise InputError(
                f"the checkpoint of step {step} cannot be written: {reason}", file=self._folder, mend=mend
            ) from None

    def _save_among_hosts(self, step: int, arrays: Any) -> None:
        """Write by Orbax's older interface: `save` of v1 (0.12) waits for every process, whichever are told to be active."""
        import orbax.checkpoint as ocp

        here = jax.process_index()
        alone = ocp.options.MultiprocessingOptions(here, active_processes={here}, barrier_sync_key_prefix=f"process {here}")
        options = ocp.CheckpointManagerOptions(
            enable_async_checkpointing=False, cleanup_tmp_directories=True, create=False, multiprocessing_options=alone
        )
        with ocp.CheckpointManager(self._folder, options=options) as manager:
            manager.save(step, args=ocp.args.StandardSave(arrays))
            manager.wait_until_finished()

    def latest(self) -> int | None:
        """Return the step of the newest whole checkpoint, None where there is none."""
        return max(self._steps(), default=None)

    def restore(self, like: Any) -> Any:
        """Return the newest state, with the shapes and types of `like`, on this process's first device.

        Raises:
            InputError: it is damaged, or of another network.
        """
        ocp, folder = _orbax(), self._folder / str(self.latest())
        here = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
        shapes = jax.tree.map(lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=here), like)
        with _quiet():
            try:
                with _alone(ocp):
                    return ocp.load(folder, shapes, checkpointable_name=NAME)
            except Exception as error:  # Orbax and its store have no common error class
                reason = str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
            _let_go()
            self._check_network(folder, like)
        _stay_quiet()
        mend = "delete this folder to go back to the checkpoint before it"
        raise InputError(f"the checkpoint cannot be read: {reason}", file=folder, mend=mend)

    def _check_network(self, folder: Path, like: Any) -> None:
        """Raise an InputError where a checkpoint cannot be read because its network is another than the scene's."""
        try:
            kept = _shapes(_orbax().metadata(folder).metadata["params"])
        except Exception:  # it is damaged
            return
        expected = _shapes(like.params)
        apart = [name for name in sorted({*kept, *expected}) if kept.get(name) != expected.get(name)]
        if not apart:
            return
        parts = [{name.split(".")[0] for name in shapes} for shapes in (kept, expected)]
        field, name = "network.method, or garment.learn_weights", apart[0]
        if parts[0] == parts[1]:
            found = ((fields, name) for pattern, fields in CHANGED.items() for name in apart if re.match(pattern, name))
            field, name = next(found, ("network", apart[0]))
        raise InputError(
            f"the network that was trained expected, with {kept.get(name, 'no array')} for {name}",
            file=folder.parents[1] / "run.json", field=f"scene: {field}", value=expected.get(name, "no array"),
            mend="the scene, or a file that it names, was changed since: change it back, or train anew into another folder",
        )  # fmt: skip

    def _steps(self) -> list[int]:
        return sorted(int(p.name) for p in self._folder.iterdir() if p.name.isdigit())

    def _tidy(self) -> None:
        """Remove what a kill left half written, and all but the newest checkpoints."""
        for step in self._steps()[:-KEPT]:
            # First out of the way: a kill while it is removed leaves no half of a checkpoint under its name.
            (self._folder / str(step)).rename(self._folder / f"{step}{TEMPORARY}")
        for left in self._folder.glob(f"*{TEMPORARY}"):
            shutil.rmtree(left)


def _shapes(params: Any) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of a network by its name, as static.layer_0.bias."""
    return {".".join(str(key.key) for key in at): tuple(a.shape) for at, a in jax.tree.leaves_with_path(params)}


def _orbax():
    """Return Orbax's API, version 1, which is about to move out of `experimental`."""
    try:
        from orbax.checkpoint import v1 as ocp
    except ImportError:
        from orbax.checkpoint.experimental import v1 as ocp
    return ocp


def _alone(ocp):
    """Return a context in which Orbax has this process, whichever it is, wait for no other."""
    context, here = ocp.Context(), jax.process_index()
    context.multiprocessing.primary_host = here
    context.multiprocessing.active_processes = {here}
    context.multiprocessing.barrier_sync_key_prefix = f"process {here}"
    return context


QUIET = ("asyncio", "absl")


@contextlib.contextmanager
def _quiet():
    """Say nothing of errors that nobody waits for: where one array is damaged, the others, still being read, have some each."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda what: hook(what) if issubclass(what.exc_type, KeyboardInterrupt) else None
    logs = {log: log.level for log in map(logging.getLogger, QUIET)}
    for log in logs:
        log.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        sys.unraisablehook = hook
        for log, level in logs.items():
            log.setLevel(level)


def _let_go(seconds: float = 3.0) -> None:
    """Wait until what else was being read has ended, nearly always: what it says comes as it ends, and as it is collected."""
    for _ in range(10):
        gc.collect()
        time.sleep(seconds / 10)


LATE = ('Error opening "', "Event loop is closed", "was never awaited")  # what is said of arrays that were still being read


def _stay_quiet() -> None:
    """Say nothing of the others as long as this process lives: some of them end with it, whenever that is."""
    hook = sys.unraisablehook
    sys.unraisablehook = lambda late: None if _is_late(late.exc_value) else hook(late)
    for log in map(logging.getLogger, QUIET):
        log.addFilter(_in_time)


def _in_time(record: logging.LogRecord) -> bool:
    return not _is_late(record.getMessage(), *(record.exc_info or ()))


def _is_late(*said: object) -> bool:
    return any(part in str(each) for each in said for part in LATE)
