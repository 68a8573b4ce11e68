"""`ncs body`: write a body at rest, to model clothes on it."""

from __future__ import annotations

from ncs_jax.cli import arguments

__all__ = ["add_commands", "body"]


def add_commands(commands) -> None:
    """Declare the options."""
    parser = arguments.command(commands, "body", body, "write a body at rest, to model clothes on it")
    arguments.add_body(parser)
    parser.add_argument("--out", required=True, metavar="FILE", help=".glb with skin and joints, or .obj; metres, Y up")


def body(options) -> int:
    """Write a body at rest, and print what it is."""
    from ncs_jax import io

    arguments.check_not_read(options.out, options.body)
    record = arguments.body_of(options)
    io.write_body(options.out, record)
    low, high = record.vertices.min(axis=0), record.vertices.max(axis=0)
    print(f"{options.body}: {len(record.vertices)} vertices, {len(record.joints)} joints, {high[1] - low[1]:.2f} m tall")
    for note in record.notes:
        print(f"  note      {note}")
    if record.posedirs is not None and options.out.lower().endswith(".glb"):
        print("  note      pose correctives are not in the .glb: its skin is linear")
    ends = [", ".join(f"{v:.2f}" for v in end) for end in (low, high)]
    print(f"wrote {options.out}, at rest, in metres with Y up: from ({ends[0]}) to ({ends[1]})")
    return 0
