"""Strict numerics for every test: float64, no silent broadcasting or promotion, and array annotations checked at run time."""

from __future__ import annotations

import os
from pathlib import Path

import jax
import numpy as np
import pytest
from jaxtyping import install_import_hook

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

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(autouse=True, scope="module")
def programs():
    """What a module has compiled is let go after it: a process may hold only so many pieces of memory, and dies of one more."""
    yield
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
