"""Solve an ensemble of stiff differential equations in float64, as one kernel.

Robertson's problem is a chemical reaction of three species, whose rates differ by nine orders of
magnitude: an explicit method would need steps of a millisecond for hours of reaction. Every
instance has rates of its own, and chooses its own steps:

    python examples/robertson.py --instances 4096

Some of the instances are compared with SciPy's implicit method of Radau.

Sources: H. H. Robertson, The solution of a set of reaction rate equations, 1966. A. Sandu et al.,
Benchmarking stiff ODE solvers for atmospheric chemistry problems II: Rosenbrock solvers,
Atmospheric Environment 31 (1997), for the method RODAS3.
"""

import argparse
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.integrate import solve_ivp

from jetbot_mjx import cli
from onekernel import fuse

RATES = (0.04, 3e7, 1e4)
"""Robertson's rates [1/s]: of the first reaction, and of the second and third one, which need two
molecules each."""

END = 1e5
"""Time until which the reaction is followed [s]."""

_START = (1.0, 0.0, 0.0)
_FIRST_STEP = 1e-6
_MOST_STEPS = 5000
_SCALE = (1.0, 1e-4, 1.0)
"""The species' usual concentrations: the second one is an intermediate product."""

_GAMMA = 0.5
_STAGES = ((), (0.0,), (2.0, 0.0), (2.0, 0.0, 1.0))
_COUPLING = ((), (4.0,), (1.0, -1.0), (1.0, -1.0, -8.0 / 3.0))
_WEIGHTS = (2.0, 0.0, 1.0, 1.0)
"""RODAS3: what the stages begin with, what they take of each other, and the weights of a step. Its
error estimate is its last stage."""


def slope(y: Float[Array, "3"], rates: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the derivative of the concentrations by time [1/s]."""
    first = rates[0] * y[0]
    second = rates[1] * y[1] * y[1]
    third = rates[2] * y[1] * y[2]
    return jnp.stack([third - first, first - second - third, second])


def one_step(
    y: Float[Array, "3"], rates: Float[Array, "3"], step: Float[Array, ""]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Make one step of RODAS3, of order 3.

    Args:
      y: the concentrations.
      rates: the rates [1/s].
      step: the length of the step [s].

    Returns:
      The concentrations after the step, and the estimated error of these.
    """
    jacobian = jax.jacfwd(slope)(y, rates)
    # The same matrix in all stages: a kernel factorises it once.
    matrix = jnp.eye(3, dtype=y.dtype) / (_GAMMA * step) - jacobian
    stages: list[Array] = []
    for begin, coupling in zip(_STAGES, _COUPLING, strict=True):
        at = sum((a * k for a, k in zip(begin, stages, strict=True)), y)
        taken = (c / step * k for c, k in zip(coupling, stages, strict=True))
        stages.append(jnp.linalg.solve(matrix, sum(taken, slope(at, rates))))
    return sum((w * k for w, k in zip(_WEIGHTS, stages, strict=True)), y), stages[-1]


def solve(
    rates: Float[Array, "3"], end: float = END, tolerance: float = 1e-7
) -> tuple[Float[Array, "3"], Int[Array, ""]]:
    """Follow one reaction to its end, with steps that the estimated error chooses.

    Args:
      rates: the rates [1/s].
      end: the time of the end [s].
      tolerance: the error of a step, relative to a concentration and to what is usual for it.

    Returns:
      The concentrations at the end, and the number of steps, with those that were repeated.
    """
    scale = jnp.asarray(_SCALE, rates.dtype)

    def goes_on(carry: tuple[Array, ...]) -> Array:
        now, *_, count = carry
        return (now < end) & (count < _MOST_STEPS)

    def advance(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        now, y, wanted, count = carry
        # The last step ends at the end.
        step = jnp.minimum(wanted, end - now)
        after, error = one_step(y, rates, step)
        allowed = tolerance * (scale + jnp.maximum(jnp.abs(y), jnp.abs(after)))
        norm = jnp.sqrt(jnp.mean(jnp.square(error / allowed)))
        is_accepted = norm < 1.0
        # The error of a step grows with the third power of its length.
        factor = jnp.clip(0.9 * jnp.maximum(norm, 1e-10) ** (-1 / 3), 0.2, 6.0)
        return (
            jnp.where(is_accepted, jnp.where(step < wanted, end, now + step), now),
            jnp.where(is_accepted, after, y),
            step * factor,
            count + 1,
        )

    zero = jnp.zeros((), rates.dtype)
    start = jnp.asarray(_START, rates.dtype)
    _, y, _, count = jax.lax.while_loop(
        goes_on, advance, (zero, start, zero + _FIRST_STEP, jnp.int32(0))
    )
    return y, count


def draw_rates(count: int, seed: int = 0) -> Float[np.ndarray, "count 3"]:
    """Draw rates around Robertson's, up to twice and down to half of them."""
    return np.asarray(RATES) * 2.0 ** np.random.default_rng(seed).uniform(-1, 1, (count, 3))


def by_scipy(rates: Float[np.ndarray, "3"], end: float = END) -> Float[np.ndarray, "3"]:
    """Return what SciPy's method of Radau finds, with narrow tolerances."""
    found = solve_ivp(
        lambda _, y: np.asarray(_slope_in_numpy(y, rates)),
        (0.0, end),
        _START,
        method="Radau",
        rtol=1e-10,
        atol=1e-10 * np.asarray(_SCALE),
    )
    return found.y[:, -1]


def _slope_in_numpy(y: np.ndarray, rates: np.ndarray) -> tuple[float, float, float]:
    first, second, third = rates[0] * y[0], rates[1] * y[1] ** 2, rates[2] * y[1] * y[2]
    return third - first, first - second - third, second


def main(arguments: Sequence[str] | None = None) -> int:
    """Solve the ensemble, and print how far some instances are from SciPy's solutions.

    Args:
      arguments: Arguments without the program's name; None: those of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", type=cli.positive_int, default=4096, help="default: 4096")
    parser.add_argument("--compared", type=cli.positive_int, default=3, help="default: 3")
    options = parser.parse_args(arguments)

    rates = draw_rates(options.instances)
    with jax.enable_x64(True):
        for name, function in {"one kernel": fuse(solve), "XLA": solve}.items():
            run = jax.jit(jax.vmap(function)).lower(rates).compile()
            begin = time.perf_counter()
            ends, counts = map(np.asarray, run(rates))
            seconds = time.perf_counter() - begin
            print(f"{name:10} {seconds:.3f} s, {counts.mean():.0f} steps an instance")
    for i in range(min(options.compared, options.instances)):
        exact = by_scipy(rates[i])
        difference = np.abs(ends[i] / exact - 1).max()
        print(f"instance {i}: {ends[i]}, {difference:.0e} from SciPy's")
    print(f"the concentrations' sums differ from 1 by {np.abs(ends.sum(axis=1) - 1).max():.0e}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
