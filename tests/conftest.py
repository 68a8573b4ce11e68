"""Strict numerics for every test: float64, no silent broadcasting or promotion, and array annotations checked at run time."""

from __future__ import annotations

import gc
import os
from importlib.metadata import version
from pathlib import Path

# Nearly all of the time goes into compiling programs that then run for milliseconds: code that is compiled four times
# faster, and runs slower. `make test-all` and `make thorough` compile as users do, and so do tests that are about that.
HAS_EMITTERS = int(version("jaxlib").split(".")[1]) < 11  # from 0.11.2 on there is nothing else, and no such flag
PLAIN_CODE = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"  # XLA counts the same
FAST = f"{PLAIN_CODE} --xla_cpu_parallel_codegen_split_count=1"  # the cores have work enough, and what is not split costs less
FAST += " --xla_cpu_use_fusion_emitters=false" * HAS_EMITTERS
GIVEN = os.environ.get("XLA_FLAGS", "").replace(FAST, "").strip()
AS_USERS = {**os.environ, "XLA_FLAGS": GIVEN}  # the environment of a process that compiles as users do
if not os.environ.get("NCS_OPTIMISED"):
    os.environ["XLA_FLAGS"] = f"{FAST} {GIVEN}"  # before JAX starts; of a flag given twice, the last counts

# For a program that runs for seconds: `jax.jit(f, compiler_options=OPTIMISED)`.
OPTIMISED = {"xla_backend_optimization_level": 3, "xla_llvm_disable_expensive_passes": False}
OPTIMISED |= {"xla_cpu_use_fusion_emitters": True} if HAS_EMITTERS else {}

import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

gc.set_threshold(50_000, 20, 50)  # tracing makes many objects, and to look for cycles took a tenth of the time

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Many tests compile the same small programs, in several processes: compile each once.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "compiled"))
jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

# Before the package is first imported; users pay nothing for it. Only the modules that compute with arrays.
ARRAYS = ["geometry", "energies", "scene.descriptors", "scene.model", "scene.features", "network"]
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"  # an int is good where a float is
install_import_hook([f"ncs_jax.{name}" for name in ARRAYS], CHECKER)

# `make thorough`: as many cases of every property and of every damaged file as a release is to withstand.
THOROUGH = bool(os.environ.get("NCS_THOROUGH"))

# Files by what they cost, the dearest first, so that no worker begins a long one when the others are done.
DEAREST = [
    *("experiments", "notebook", "self_contact", "layers", "swing", "stiffness", "benchmarks", "devices", "runs", "properties"),
    *("collision", "training", "export", "evaluation", "methods", "cost", "fit", "own", "motion", "objective", "patch", "gltf"),
]


def pytest_collection_modifyitems(items):
    order = {f"test_{name}": place for place, name in enumerate(DEAREST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(order)))


DATA = Path(__file__).parents[2] / "shared" / "data"


MAPS = Path("/proc/self/maps")  # Linux lets a process have 65,530 pieces of memory
ENOUGH = 30_000


@pytest.fixture(autouse=True, scope="module")
def programs():
    """Let compiled programs go before they are too many: each holds some ten pieces of memory, and a process may run out."""
    yield
    if not MAPS.exists() or MAPS.read_bytes().count(b"\n") > ENOUGH:
        jax.clear_caches()


@pytest.fixture
def rng() -> np.random.Generator:
    """The only randomness of the tests, the same in every run."""
    return np.random.default_rng(20220601)


@pytest.fixture
def data() -> Path:
    """The folder of recordings and bodies whose licences keep them out of the repository."""
    if not DATA.is_dir():
        pytest.skip("needs ../shared/data, which is not part of the project")
    return DATA


@pytest.fixture
def plain_jax():
    """JAX as a user has it: float32 and its own promotion rules."""
    with jax.enable_x64(False), jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield
