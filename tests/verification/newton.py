"""A minimiser for the closed forms of this folder: dense Newton with a line search, for some tens of vertices in float64."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # what compiles runs but a few times


def minimiser(energy: Callable, places: tuple[int, ...]) -> Callable:
    """`solve(x, *operands)`: the positions (verts, 3) near x where `energy(x, *operands)` is stationary and convex.

    places: which of the 3 verts coordinates may move. Ends where a full Newton step no longer lowers the largest force, and
    fails the test where that force is not rounding by then.
    """
    free = jnp.asarray(places)

    def of_free(y, x, *operands):
        return energy(x.reshape(-1).at[free].set(y).reshape(x.shape), *operands)

    value = jax.jit(of_free, compiler_options=QUICK)
    derivatives = jax.jit(lambda *a: (jax.grad(of_free)(*a), jax.hessian(of_free)(*a)), compiler_options=QUICK)

    def solve(x, *operands):
        x = jnp.asarray(x, jnp.float64)
        y = np.asarray(x).reshape(-1)[list(places)]
        scale, last = 0.0, np.inf
        for _ in range(200):
            gradient, hessian = (np.asarray(a) for a in derivatives(y, x, *operands))
            size = np.abs(gradient).max()
            scale = max(scale, np.abs(hessian).max() * np.abs(y).max() + size)
            convex = np.linalg.eigvalsh(hessian)[0]
            if convex > 0 and size >= 0.5 * last and size < 1e-11 * scale:
                return x.reshape(-1).at[free].set(y).reshape(x.shape)
            last = size if convex > 0 else np.inf
            if convex <= 0:
                hessian = hessian + (1e-6 * np.abs(hessian).max() - 1.5 * convex) * np.eye(len(y))
            step = -np.linalg.solve(hessian, gradient)
            start, t = float(value(y, x, *operands)), 1.0
            while float(value(y + t * step, x, *operands)) > start + 1e-13 * abs(start) + 1e-4 * t * float(gradient @ step):
                t /= 2
                if t < 1e-6:  # the fall is below rounding: take the step if it lowers the force
                    t = 1.0
                    break
            y = y + t * step
        raise AssertionError(f"no minimum found: a force of {last:.2g} is left")

    return solve


def order(errors, ratio: float = 2.0) -> float:
    """Observed order of convergence from the last two errors, their resolutions a factor apart."""
    return float(np.log(abs(errors[-2]) / abs(errors[-1])) / np.log(ratio))
