"""Compare the costs of MJX's line search by their differences, which float32 resolves.

MJX compares total costs. That of a driving JetBot is about 150, of which float32 resolves 1.5e-5,
and MJX refuses a step that gains less. The solver then ends where it began: in one physics step of
a thousand more than 5e-5 rad/s away from the solution. Here the cost of a point is its difference
to the cost at the beginning of the search. The large common part is left out, not subtracted.
MuJoCo Warp does the same (google-deepmind/mujoco_warp#1374).
"""

import contextlib
import threading
from collections.abc import Iterator
from unittest import mock

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from jetbot_mjx.envs.mjx import ConeType, Data, Model, solver

_library = solver._linesearch, solver._LSPoint.create
_lock = threading.RLock()


class _Thread(threading.local):
    """Hold what is true for the present thread alone: others may trace MJX meanwhile."""

    in_context = False
    is_relative = False
    """Whether the costs of points are relative."""


_thread = _Thread()


@contextlib.contextmanager
def relative_costs() -> Iterator[None]:
    """Replace MJX's line search by this module's in a context, for the present thread."""
    # One thread at a time: otherwise a second thread would restore the first one's replacement.
    with (
        _lock,
        mock.patch.object(solver, "_linesearch", _line_search),
        mock.patch.object(solver._LSPoint, "create", _point),
        mock.patch.object(_thread, "in_context", True),
    ):
        yield


def _line_search(m: Model, d: Data, ctx: solver.Context) -> solver.Context:
    """Make MJX's line search with relative costs.

    Elliptic cones and dry friction in joints, whose costs are not quadratic, are passed to MJX.
    """
    search, _ = _library
    rows = d._impl
    assert isinstance(rows, solver.DataJAX)
    if not _thread.in_context or m.opt.cone != ConeType.PYRAMIDAL or rows.nf:
        return search(m, d, ctx)
    # MJX takes the difference of a point's cost and `gauss` for the cost of the constraints.
    relative = ctx.replace(gauss=ctx.gauss - ctx.cost)
    with mock.patch.object(_thread, "is_relative", True):
        return search(m, d, relative).replace(gauss=ctx.gauss)


def _point(*arguments: PyTree) -> solver._LSPoint:
    _, create = _library
    return _relative_point(*arguments) if _thread.is_relative else create(*arguments)


def _relative_point(
    m: Model,
    d: Data,
    ctx: solver.Context,
    alpha: Float[Array, ""],
    jv: Float[Array, " rows"],
    quad: Float[Array, "rows 3"],
    quad_gauss: Float[Array, "3"],
    *cone: Array,
) -> solver._LSPoint:
    """Return a point of the line search, with its cost relative to that at `alpha` = 0.

    The cost is quadratic in `alpha`. Its constant part changes only by the rows of constraints that
    become active or inactive between 0 and `alpha`.

    Args:
      m: the model.
      d: the simulation data.
      ctx: the solver's state at the beginning of the search.
      alpha: the length of the step.
      jv: the change of `ctx.Jaref` with `alpha`.
      quad: the coefficients of each row's cost: constant, linear, quadratic.
      quad_gauss: the coefficients of the cost without constraints.
      *cone: quantities of elliptic cones.
    """
    _, create = _library
    rows = d._impl
    assert isinstance(rows, solver.DataJAX)
    # Equality constraints, which come first, are always active.
    is_equality = jnp.arange(len(jv)) < rows.ne
    before = is_equality | (ctx.Jaref < 0)
    after = is_equality | (ctx.Jaref + alpha * jv < 0)
    # A row that stays active has no constant part; one that no longer is takes its own along.
    constant = quad[:, 0]
    appears, disappears = jnp.where(before, 0.0, constant), jnp.where(before, -constant, 0.0)
    stays = quad.at[:, 0].set(appears)
    goes = jnp.zeros_like(quad).at[:, 0].set(disappears)
    chosen = jnp.where(after[:, None], stays, goes)
    # MJX would decide once more which rows are active, and at the boundary otherwise: XLA may round
    # the same sum differently in two places. For MJX, all of them are.
    always = ctx.replace(Jaref=-jnp.ones_like(ctx.Jaref))
    quad_gauss *= jnp.array([0.0, 1.0, 1.0])
    return create(m, d, always, alpha, jnp.zeros_like(jv), chosen, quad_gauss, *cone)
