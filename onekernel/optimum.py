"""Differentiate the optimum that MJX's constraint solver finds, whatever led there.

Motivation: MJX's solver is a `while_loop`, of which JAX has no reverse mode, and whose forward mode
differentiates every iteration.

Protocol: the acceleration a at which the solver ends is a minimum, so the gradient g(a, x) of the
cost is 0 there, where x is all that the cost depends on. A change of x moves a by da, and g stays
0: H da = -dg, with the Hessian H of the cost at a, and dg the change of g at a fixed a. That is
`jax.lax.custom_root`. It has a forward and a reverse mode of any order, and neither repeats the
iterations. `jax.checkpoint` may store a, whose name is `SOLUTION`, and compute the rest again.

The derivative is that of the optimum also where a solver that may make few iterations has not
reached it. Constraints that are just about to become active have a derivative from either side;
this is the one of the side on which a is.
"""

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import cast
from unittest import mock

import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float
from mujoco.mjx._src import solver

SOLUTION = "acceleration of the constraint solver"
"""Name of the only values that a differentiated step needs to store."""

_iterate = solver.solve
_lock = threading.RLock()


class _Thread(threading.local):
    """Hold what is true for the present thread alone: others may trace MJX meanwhile."""

    in_context = False


_thread = _Thread()


@contextlib.contextmanager
def differentiable_solver() -> Iterator[None]:
    """Replace MJX's solver by one that can be differentiated, in a context of this thread."""
    # One thread at a time: otherwise a second thread would restore the first one's replacement.
    with (
        _lock,
        mock.patch.object(solver, "solve", _solve),
        mock.patch.object(_thread, "in_context", True),
    ):
        yield


def _solve(m: solver.Model, d: solver.Data) -> solver.Data:
    """Solve as MJX does, with the derivatives of the optimum.

    Args:
      m: the model.
      d: the simulation data, with the constraints and `qacc_smooth`.

    Returns:
      The data with `qacc`, `qfrc_constraint` and `efc_force`.
    """
    if not _thread.in_context:
        return _iterate(m, d)

    def context(qacc: Float[Array, " nv"]) -> solver.Context:
        return solver.Context.create(m, d.replace(qacc=qacc), grad=False)

    def gradient(qacc: Float[Array, " nv"]) -> Float[Array, " nv"]:
        at = context(qacc)
        return at.Ma - d.qfrc_smooth - at.qfrc_constraint

    fixed_model, fixed_data = jax.lax.stop_gradient((m, d))
    optimum = checkpoint_name(_iterate(fixed_model, fixed_data).qacc, SOLUTION)
    qacc = jax.lax.custom_root(gradient, optimum, lambda _, guess: guess, _solve_linear)
    at = context(qacc)
    found = {"qacc": qacc, "qfrc_constraint": at.qfrc_constraint, "_impl.efc_force": at.efc_force}
    return cast(solver.Data, d.tree_replace(found))


def _solve_linear(
    function: Callable[[Float[Array, " nv"]], Float[Array, " nv"]], result: Float[Array, " nv"]
) -> Float[Array, " nv"]:
    """Return the argument for which a linear function, whose matrix is a Hessian, has a result."""
    hessian = jax.jacfwd(function)(jnp.zeros_like(result))
    return jax.scipy.linalg.solve(hessian, result, assume_a="pos")
