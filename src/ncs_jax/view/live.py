"""A garment live in a browser page (viser): play, scrub, orbit, alpha, other motions, overlays, and colours that measure."""

from __future__ import annotations

import functools
import itertools
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ncs_jax.energies.contact.distance import nearest_distance
from ncs_jax.energies.contact.surface import Surface
from ncs_jax.errors import InputError
from ncs_jax.geometry.mesh import edge_strain
from ncs_jax.geometry.triangle_crossings import crossed
from ncs_jax.metrics.motion import carried, unposed
from ncs_jax.runs.run import Run, assemble, load_run, read_animation_over
from ncs_jax.scene.features import MotionFeatures
from ncs_jax.scene.model import Model, pose_body
from ncs_jax.scene.spec import load_scene
from ncs_jax.view.character import posed_body

__all__ = ["COLOURS", "AnimatedGarment", "View", "animated_garment", "colour_bins", "vertex_values", "view"]

CLOTH, SKIN, WORN, OTHER = (221, 91, 49), (176, 168, 160), (128, 153, 178), (70, 130, 180)
OVER = (92, 135, 145), (217, 186, 115)  # garments over the innermost, in turn
BINS = 16  # colours of a scale
THROUGH = "inside the body, or through it or the cloth"  # vertices, and those of triangles that another one passes through
# What a colour can measure: its unit and the value at the scale's end.
COLOURS = {
    "strain": ("%", 10.0),
    "speed as seen from the body": ("mm/s", 500.0),
    "distance inside the body": ("mm", 5.0),
    THROUGH: ("%", 100.0),
    "distance to the overlay": ("mm", 50.0),
}


@dataclass(frozen=True)
class AnimatedGarment:
    """Hold what is looked at: a trained garment, an animation from a file, or a scene whose garment only follows the skin.

    Attributes:
        run: its scene, and its parameters where it is trained. motions: that it has vertices for, by name.
        animate: (motion, alpha) -> vertices (frames, verts, 3), m. controlled: whether alpha does anything. title: of the page.
    """

    run: Run
    motions: tuple[str, ...]
    animate: Callable[[str, float], np.ndarray]
    controlled: bool
    title: str


def animated_garment(target: str, scene: str | None = None, motion: str | None = None) -> AnimatedGarment:
    """Open a run folder, an animation file together with its scene and motion, or a scene.

    Raises:
        InputError: it is none of these, or does not fit together.
    """
    path = Path(target)
    if path.is_dir() and (path / "run.json").exists():
        run = load_run(path)
        spec = run.assembly.scene.motion
        animate = functools.partial(run.animate, outside=True)
        return AnimatedGarment(run, _motions(motion, spec), animate, run.assembly.network.controlled, path.name)
    is_scene = target.startswith("ncs:") or path.suffix == ".toml"
    if not is_scene and scene is None:
        raise InputError("the scene of the animation is needed", file=target, field="--scene", mend="add --scene SCENE")
    loaded = load_scene(target if is_scene else str(scene))
    if loaded.moves_by_itself:
        mend = "ncs simulate SCENE --out FILE.glb --body writes both, for any viewer"
        raise InputError(
            "a character expected to be shown live", file=target, field="body.file", value=loaded.body.file, mend=mend
        )
    run = Run(assemble(loaded.without_network()), {})
    motions = _motions(motion, loaded.motion)
    if is_scene:

        def follow_skin(name: str, alpha: float) -> np.ndarray:
            track = run.track(name)
            return np.asarray(track.absolute(carried(run.assembly.model, track.matrices)))

        return AnimatedGarment(run, motions, follow_skin, False, target)
    vertices = read_animation_over(target, run.assembly.model, run.track(motions[0]))
    return AnimatedGarment(run, motions[:1], lambda name, alpha: vertices, False, path.name)


def _motions(motion: str | None, spec) -> tuple[str, ...]:
    names = (motion,) if motion else tuple(dict.fromkeys((*spec.validation, *spec.files)))
    if not names:
        raise InputError("a motion is needed", field="--motion", mend="give one: the scene has none")
    return names


@jax.jit
def _inside(model: Model, surface: Surface, x, matrices):
    """Return how deep vertices are inside the body, m, and the body."""
    body = pose_body(model, matrices)
    return -nearest_distance(x, body, surface), body


def vertex_values(
    name: str, run: Run, vertices: np.ndarray, track: MotionFeatures, frame: int, other: np.ndarray | None
) -> np.ndarray:
    """Return one of `COLOURS` for every vertex in one frame (verts,), in its unit; other is the overlay, if there is one."""
    model, x = run.assembly.model, vertices[frame]
    if name == "strain":
        mesh = model.garment.mesh
        edges, strain = np.asarray(mesh.edges), 100 * np.asarray(jax.jit(edge_strain)(x, mesh))
        total = sum(np.bincount(edges[:, k], strain, len(x)) for k in (0, 1))
        return total / np.maximum(np.bincount(edges.ravel(), minlength=len(x)), 1)
    if name.startswith("speed"):
        at = slice(max(frame - 1, 0), frame + 1)
        part = jax.tree.map(lambda a: a[at], track)
        u = unposed(model, vertices[at], part)
        return 1000 * model.fps * np.linalg.norm(u[-1] - u[0], axis=1)
    if name.startswith("distance to"):
        return 1000 * np.linalg.norm(x - other[frame], axis=1) if other is not None else np.zeros(len(x))
    origin = np.asarray(track.matrices[frame, 0, :, 3])
    local = jnp.asarray(track.relative(x[None])[0] - origin, model.basis.dtype)
    matrices = track.matrices[frame].at[:, :, 3].add(-origin)
    depth, body = (np.zeros(len(x)), None) if model.surface is None else _inside(model, model.surface, local, matrices)
    depth = 1000 * np.maximum(np.asarray(depth), 0)
    return depth if name != THROUGH else 100.0 * ((depth > 0) | _through(model, np.asarray(local), body))


def _through(model: Model, x: np.ndarray, body: jax.Array | None) -> np.ndarray:
    """Return which vertices (verts,) are of triangles that one of the garment or of the body passes through."""
    faces = np.asarray(model.garment.mesh.faces)
    found = crossed(x, faces)
    if body is not None and model.surface is not None:
        found |= crossed(x, faces, np.asarray(body), np.asarray(model.surface.faces))
    marked = np.zeros(len(x), bool)
    marked[faces[found]] = True
    return marked


def colour_bins(values: np.ndarray, faces: np.ndarray, most: float) -> np.ndarray:
    """Return the number of every face's colour (faces,), 0 to `BINS` - 1, by the mean of its corners; `most` ends the scale."""
    share = values[faces].mean(axis=1) / most
    return np.clip((BINS * share).astype(int), 0, BINS - 1)


def _scale_colour(share: float) -> tuple[int, int, int]:
    """Return the colour at a share of the scale, from pale over orange to red."""
    stops = np.array([[236, 231, 222], [250, 200, 120], [230, 110, 50], [150, 15, 30]], float)
    at = share * (len(stops) - 1)
    low = min(int(at), len(stops) - 2)
    red, green, blue = (stops[low] + (at - low) * (stops[low + 1] - stops[low])).round().astype(int).tolist()
    return red, green, blue


class View:
    """Serve a page that shows a garment; `wait` keeps it playing, `close` ends it."""

    def __init__(
        self, subject: AnimatedGarment, overlays: dict[str, np.ndarray], *, host: str = "127.0.0.1", port: int = 8080
    ) -> None:
        """Start serving; overlays are further animations of the first motion, by name."""
        import viser

        self.subject, self.overlays, self.frame, self._changed = subject, overlays, 0, True
        self._closed = False
        self._player: threading.Thread | None = None
        self._lock = threading.RLock()
        self.server = viser.ViserServer(host, port, label=subject.title, verbose=False)
        self.faces = np.asarray(subject.run.assembly.garment.faces)
        run = subject.run
        # Another alpha leaves the body as it is.
        self._posed_body = functools.lru_cache(1)(lambda name: posed_body(run.assembly, run.motion(name)))
        self._coverage_of = functools.lru_cache(1)(lambda name: run.coverage(name) if run.params else None)
        self._add_meshes()
        self._add_controls()
        self._load()

    @property
    def address(self) -> str:
        """Return where the page is."""
        return f"http://{self.server.get_host()}:{self.server.get_port()}"

    def _add_meshes(self) -> None:
        scene, body = self.server.scene, self.subject.run.assembly.body
        scene.set_up_direction("+y")
        scene.add_grid("/ground", 20, 20, plane="xz", cell_size=0.5)
        rest = self.subject.run.assembly.garment.vertices
        low = float(rest.min(axis=0)[1]) if body is None else float(body.vertices.min(axis=0)[1])
        tall = float(np.ptp((rest if body is None else body.vertices)[:, 1]))
        self.server.initial_camera.position = (0.6 * tall, low + 0.8 * tall, 2.0 * tall)
        self.server.initial_camera.look_at = (0.0, low + 0.5 * tall, 0.0)
        self.server.initial_camera.fov = np.radians(40)
        mesh = functools.partial(scene.add_mesh_simple, side="double")
        starts = (0, *self.subject.run.assembly.garment.layers, len(rest))
        self.cloths = []  # garments worn together: their vertices, and what shows them
        for k, (first, stop) in enumerate(itertools.pairwise(starts)):
            own = self.faces[(first <= self.faces[:, 0]) & (self.faces[:, 0] < stop)] - first
            colour = CLOTH if not k else OVER[(k - 1) % len(OVER)]
            self.cloths.append((slice(first, stop), mesh(f"/garment/{k}", rest[first:stop], own, color=colour)))
        posed = self._posed_body(self.subject.motions[0])
        self.body_meshes = []  # the body and the garments below: their vertices, and what shows them
        if posed is not None:
            end = posed.vertices.shape[1]
            bare = end - posed.worn
            for name, part, colour in (("/body", slice(0, bare), SKIN), ("/worn", slice(bare, end), WORN)):
                own = posed.faces[(part.start <= posed.faces[:, 0]) & (posed.faces[:, 0] < part.stop)] - part.start
                if len(own):
                    self.body_meshes.append((part, mesh(name, posed.vertices[0, part], own, color=colour)))
        self.other = mesh("/overlay", rest, self.faces, color=OTHER, opacity=0.5, visible=False)
        one = np.zeros((3, 3), np.float32)
        self.bins = [
            mesh(
                f"/colours/{k}",
                one,
                np.array([[0, 1, 2]]),
                color=_scale_colour(k / (BINS - 1)),
                flat_shading=True,
                visible=False,
            )
            for k in range(BINS)
        ]

    def _add_controls(self) -> None:
        gui, subject = self.server.gui, self.subject
        self.playing = gui.add_checkbox("play", True)
        self.scrub = gui.add_slider("frame", 0, 1, 1, 0)
        self.speed = gui.add_slider("speed", 0.1, 2.0, 0.1, 1.0)
        self.motion = gui.add_dropdown("motion", subject.motions, initial_value=subject.motions[0])
        self.alpha = gui.add_slider("alpha", 0.0, 3.0, 0.05, 1.0, disabled=not subject.controlled)
        self.colour = gui.add_dropdown("colour", ("cloth", *COLOURS), initial_value="cloth")
        self.overlay = gui.add_dropdown("overlay", ("none", *self.overlays), initial_value="none", visible=bool(self.overlays))
        self.show_body = gui.add_checkbox("body", bool(self.body_meshes), disabled=not self.body_meshes)
        self.follow = gui.add_checkbox("keep in the middle", True)
        self.caption = gui.add_markdown("")
        reload: tuple[Any, ...] = (self.motion, self.alpha)
        redraw: tuple[Any, ...] = (self.scrub, self.colour, self.overlay, self.show_body, self.follow)
        for handle in reload:
            handle.on_update(lambda _: self._load())
        for handle in redraw:
            handle.on_update(lambda _: self._redraw())

    def _redraw(self) -> None:
        """Have the next round of `wait` send the frame again, that of the slider while nothing plays."""
        with self._lock:
            if not self.playing.value:
                self.frame = int(self.scrub.value)
            self._changed = True

    def _load(self) -> None:
        """Animate the chosen motion with the chosen alpha."""
        with self._lock:
            run, name = self.subject.run, self.motion.value
            self.track = run.track(name)
            self.vertices = self.subject.animate(name, float(self.alpha.value))
            self.coverage = self._coverage_of(name)
            posed = self._posed_body(name)
            self.body = posed.vertices if posed is not None else np.zeros((len(self.vertices), 0, 3), np.float32)
            self.fps = run.assembly.model.fps
            self.scrub.max = max(len(self.vertices) - 1, 1)
            self.frame, self._changed = self.frame % len(self.vertices), True

    def show(self) -> None:
        """Send the present frame to the page."""
        with self._lock, self.server.atomic():
            frame, x = self.frame, self.vertices[self.frame]
            middle = np.zeros(3, np.float32)
            if self.follow.value:
                middle[[0, 2]] = x.mean(axis=0)[[0, 2]]
            other = self.overlays.get(self.overlay.value)
            other = other if other is not None and len(other) == len(self.vertices) else None
            for part, drawn in self.body_meshes:
                drawn.visible = bool(self.show_body.value)
                drawn.vertices = self.body[frame, part] - middle
            self.other.visible = other is not None
            if other is not None:
                self.other.vertices = other[frame] - middle
            for part, drawn in self.cloths:
                drawn.visible = self.colour.value == "cloth"
                drawn.vertices = x[part] - middle
            self.caption.content = self._coloured(x - middle, frame, other)
            if self.playing.value:
                self.scrub.value = frame
            self._changed = False

    def _coloured(self, x: np.ndarray, frame: int, other: np.ndarray | None) -> str:
        """Colour the faces, and return a caption that says what the colours are."""
        name = self.colour.value
        if name == "cloth":
            for part in self.bins:
                part.visible = False
            return f"frame {frame} of {len(self.vertices)}, {frame / self.fps:.2f} s{self._beyond(frame)}"
        values = vertex_values(name, self.subject.run, self.vertices, self.track, frame, other)
        unit, most = COLOURS[name]
        chosen = colour_bins(values, self.faces, most)
        for k, part in enumerate(self.bins):
            own = self.faces[chosen == k]
            part.visible = len(own) > 0
            if len(own):
                used, local = np.unique(own, return_inverse=True)
                part.vertices, part.faces = x[used], local.reshape(-1, 3).astype(np.uint32)
        return (
            f"frame {frame}, {frame / self.fps:.2f} s: {name}, mean {values.mean():.3g}, at most {values.max():.3g} {unit}; "
            f"the scale ends at {most:g} {unit}"
        )

    def _beyond(self, frame: int) -> str:
        """Return a caption's words where the frame is beyond what the run was trained on."""
        found = self.coverage
        if found is None or not found.outside[frame]:
            return ""
        joint = found.joints[int(np.argmax(np.maximum(found.poses[frame], found.speeds[frame])))]
        return f": beyond what it was trained on, by {joint}"

    def wait(self, seconds: float | None = None) -> None:
        """Play until interrupted, or for some seconds."""
        end = None if seconds is None else time.monotonic() + seconds
        while not self._closed and (end is None or time.monotonic() < end):
            began = time.monotonic()
            with self._lock:
                if self.playing.value and len(self.server.get_clients()):
                    self.frame, self._changed = (self.frame + 1) % len(self.vertices), True
            if self._changed:
                self.show()
            time.sleep(max(1 / (self.fps * self.speed.value) - (time.monotonic() - began), 0.002))

    def close(self) -> None:
        """End the server."""
        self._closed = True
        if self._player is not None:
            self._player.join()
        self.server.stop()

    def _repr_html_(self) -> str:
        """Show the page in a notebook, where it plays until it is closed; the browser has to reach this machine's port."""
        if self._player is None:
            self._player = threading.Thread(target=self.wait, daemon=True)
            self._player.start()
        return f'<iframe src="{self.address}" width="100%" height="600" style="border: 0"></iframe>'


def view(
    target: str, *, scene: str | None = None, motion: str | None = None, overlays: Sequence[str] = (), **where: Any
) -> View:
    """Serve a page that shows a run, an animation file with its scene, or a scene: see `View`.

    Args:
        target: see `animated_garment`. scene: of an animation file. motion: to begin with; all of the scene's can be chosen.
        overlays: run folders or animation files of the first motion. where: host and port.

    Raises:
        InputError: what is named cannot be read or does not fit, or viser, of the `view` extra, is not there.
    """
    try:
        import viser  # noqa: F401
    except ImportError:
        raise InputError("viser is needed to look at a garment live", mend="pip install viser") from None
    subject = animated_garment(target, scene, motion)
    first = subject.motions[0]
    others = {
        Path(name).name: load_run(name).animate(first, outside=True)
        if Path(name).is_dir()
        else read_animation_over(name, subject.run.assembly.model, subject.run.track(first))
        for name in overlays
    }
    return View(subject, others, **where)
