"""No compiled program does more than it did: XLA's own counts beside the recorded ones, see `benchmarks/cost.py`.

    python -m tests.test_cost

records them anew, for whoever means a program to do more; the commit says why.
"""

import json
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from benchmarks.cost import COUNTS, counted

from .conftest import AS_USERS, PLAIN_CODE
from .scenes import write_scene

RECORD = Path(__file__).parent / "cost.json"
KEY = f"jax {jax.__version__}, {jax.default_backend()}, {platform.machine()}"
TOLERANCE = 0.03


def measured(folder, *options):
    """The counts of the scene of the tests, from a process of its own: programs as a user has them, and a time limit."""
    out = folder / "cost.json"
    command = [sys.executable, "-m", "benchmarks.cost", str(write_scene(folder)), "--json", str(out), *options]
    environment = {**AS_USERS, "XLA_FLAGS": f"{PLAIN_CODE} {AS_USERS['XLA_FLAGS']}"}
    subprocess.run(command, check=True, timeout=300, cwd=RECORD.parents[1], env=environment, stdout=subprocess.DEVNULL)
    return json.loads(out.read_text())["rows"]


def grown(now, before):
    """Which counts have grown by more than the tolerance, and how many times as great they are."""
    return {k: now[k] / max(before[k], 1) for k in before if now[k] > (1 + TOLERANCE) * before[k]}


@pytest.mark.parametrize("quick", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_no_program_has_grown(tmp_path, quick):
    """But for Newton's, unless slow tests run too."""
    before = json.loads(RECORD.read_text()).get(KEY)
    if before is None:
        pytest.skip(f"nothing is recorded for {KEY}; record it with python -m tests.test_cost")
    now = measured(tmp_path, *["--quick"] * quick)
    assert set(before) - set(now) == ({"newton"} if quick else set())
    more = {name: found for name in now if (found := grown(now[name], before[name]))}
    assert not more, f"times what was recorded: {more}; if that is meant, record it with python -m tests.test_cost"


def test_what_has_grown():
    before = {"flops": 100, "bytes": 1000, "temporary": 0, "rounds": 0}
    assert not grown(before | {"flops": 103, "bytes": 10}, before)
    assert grown(before | {"flops": 104}, before) == {"flops": 1.04}
    assert grown(before | {"temporary": 64}, before) == {"temporary": 64}


def test_a_slower_program_is_seen():
    """The same product twice, and then in a loop of three."""
    x = jnp.ones((64, 64), jnp.float32)
    once = counted(jax.jit(lambda x: x @ x).lower(x))
    assert tuple(once) == COUNTS and once["flops"] == pytest.approx(2 * 64**3, rel=0.01) and once["rounds"] == 0
    twice = grown(counted(jax.jit(lambda x: (x @ x) @ x).lower(x)), once)
    assert twice["flops"] > 1.9 and twice["bytes"] > 1.9
    loop = counted(jax.jit(lambda x: jax.lax.fori_loop(0, 3, lambda _, y: x @ y, x)).lower(x))
    assert grown(loop, once)["rounds"] == 3


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        found = {KEY: measured(Path(folder))}
    known = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    RECORD.write_text(json.dumps(known | found, indent=2) + "\n")
