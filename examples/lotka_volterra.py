"""Estimate the parameters of an ensemble of Lotka-Volterra systems by gradients.

Prey x and predators y follow x' = a x - b x y and y' = c x y - d y. Every instance has noisy
observations of its own, and a guess of its own. The loss of one instance, integration included, is
a JAX function; `fuse` makes it and its gradient one kernel for all instances.

    python examples/lotka_volterra.py
"""

import argparse
import functools
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float

from jetbot_mjx import cli
from onekernel import fuse

OBSERVATIONS = 20
"""Number of times at which an instance is observed, `SPACING` apart."""

SPACING = 0.5  # [s]
_STEPS = 16  # of the Runge-Kutta method between two observations
_START = jnp.array([1.0, 0.6])  # prey and predators at the first observation
_MEAN = jnp.log(jnp.array([1.1, 0.9, 0.7, 0.8]))  # of the logarithms of a, b, c, d
_SPREAD, _NOISE = 0.2, 0.03

Parameters = Float[Array, "4"]
"""The logarithms of a, b, c and d, which are positive so."""

Observed = Float[Array, "times 2"]


def observe(parameters: Parameters) -> Observed:
    """Return prey and predators at the times of the observations, by the classical RK4 method."""
    a, b, c, d = jnp.exp(parameters)

    def slope(state: Float[Array, "2"]) -> Float[Array, "2"]:
        x, y = state
        return jnp.stack([a * x - b * x * y, c * x * y - d * y])

    def step(state: Float[Array, "2"], _: None) -> tuple[Float[Array, "2"], None]:
        dt = SPACING / _STEPS
        first = slope(state)
        second = slope(state + dt / 2 * first)
        third = slope(state + dt / 2 * second)
        fourth = slope(state + dt * third)
        return state + dt / 6 * (first + 2 * second + 2 * third + fourth), None

    # Stored for the way back is the state at each observation; what is between is computed again.
    @jax.checkpoint
    def between(state: Float[Array, "2"], _: None) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        state, _ = jax.lax.scan(step, state, length=_STEPS)
        return state, state

    return jax.lax.scan(between, _START, length=OBSERVATIONS)[1]


def loss(parameters: Parameters, observed: Observed) -> Float[Array, ""]:
    """Return the mean squared error of the logarithms of one instance's populations."""
    return jnp.mean((jnp.log(observe(parameters)) - jnp.log(observed)) ** 2)


def draw(key: Array) -> tuple[Parameters, Observed]:
    """Draw the parameters of an instance, and observe it with noise."""
    of_parameters, of_noise = jax.random.split(key)
    parameters = _MEAN + _SPREAD * jax.random.normal(of_parameters, (4,))
    noise = jnp.exp(_NOISE * jax.random.normal(of_noise, (OBSERVATIONS, 2)))
    return parameters, observe(parameters) * noise


def estimate(
    observed: Float[Array, "n times 2"],
    steps: int = 300,
    compiler: Callable[[Callable], Callable] = fuse,
) -> tuple[Float[Array, "n 4"], Float[Array, "n"]]:
    """Estimate the parameters of all instances by Adam, from the mean parameters on.

    Args:
      observed: the observations of n instances.
      steps: the number of steps.
      compiler: what compiles the loss with its gradient, `fuse` or nothing (XLA).

    Returns:
      The logarithms of the parameters, and the loss of each instance.
    """
    gradient = jax.vmap(compiler(jax.value_and_grad(loss)))
    adam = optax.adam(optax.cosine_decay_schedule(0.05, steps))

    def step(carry: tuple, _: None) -> tuple[tuple, None]:
        parameters, state = carry
        updates, state = adam.update(gradient(parameters, observed)[1], state)
        return (optax.apply_updates(parameters, updates), state), None

    first = jnp.broadcast_to(_MEAN, (len(observed), 4))
    parameters, _ = jax.lax.scan(step, (first, adam.init(first)), length=steps)[0]
    return parameters, gradient(parameters, observed)[0]


def main(arguments: Sequence[str] | None = None) -> int:
    """Estimate an ensemble by one kernel and by XLA, and print errors and times.

    Args:
      arguments: Arguments without the program's name; None: those of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", type=cli.positive_int, default=4096, help="default: 4096")
    parser.add_argument("--steps", type=cli.positive_int, default=300, help="of Adam, default: 300")
    options = parser.parse_args(arguments)
    true, observed = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(0), options.instances))
    for name, compiler in (("one kernel", fuse), ("XLA", lambda function: function)):
        run = jax.jit(functools.partial(estimate, steps=options.steps, compiler=compiler))
        compiled = run.lower(observed).compile()
        begin = time.perf_counter()
        found, losses = jax.block_until_ready(compiled(observed))
        seconds = time.perf_counter() - begin
        errors = jnp.median(jnp.abs(jnp.exp(found - true) - 1), axis=0)
        print(
            f"{name:10} {seconds:.2f} s, median loss {jnp.median(losses):.1e}, median errors of"
            f" a, b, c, d: {', '.join(f'{error:.1%}' for error in errors)}"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
