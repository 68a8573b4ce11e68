"""The command lines of the package that the add-on calls; each in the folder that holds what it reads."""

import shlex


def check() -> list[str]:
    """Check a scene, and draw its motions."""
    return ["check", "scene.toml", "--out", "check.png"]


def fit(find_place: bool, more: str = "") -> list[str]:
    """Fit the garment; it stays as it is, unless its unit, axes and place are to be found. more: options besides."""
    place = [] if find_place else ["--scale", "1", "--up", "y", "--turn", "0", "--stay"]
    return ["fit", "garment.npz", "--body", "body.npz", "--out", "fitted.npz", *place, *shlex.split(more)]


def train(minutes: float, resume: bool) -> list[str]:
    """Train, or go on."""
    return ["train", "scene.toml", "--out", "run", "--minutes", f"{minutes:.4g}", *(["--resume"] if resume else [])]


def animate(alpha: float) -> list[str]:
    """Animate a motion."""
    return ["animate", "run", "--motion", "baked.npz", f"--alpha={alpha:.9g}", "--out", "baked.pc2"]


def stream() -> list[str]:
    """Answer frames."""
    return ["stream", "run"]
