"""A kernel of one multiplication, and a count of the kernels that a program calls."""

import jax
import jax.numpy as jnp

from onekernel import gpu, kernel
from onekernel.lower.jaxpr import scalarize


def once(changing, held):
    return {"x": changing["x"] * held, "n": changing["n"] + 1}


def fallback(n, x, held):
    """The leaves of two steps, as a dictionary orders them."""
    return [n + 2, x * held * held]


def made(**options):
    shapes = {"x": jnp.zeros(3), "n": jnp.zeros(())}
    program = scalarize(once, shapes, jnp.zeros(()))
    return kernel.Kernel(program, carried=2, steps=2, fallback=fallback, **options).as_step()


def lowered_text(function, *arguments, platforms=None):
    """A program as StableHLO, for the platform that it is lowered for."""
    # A function of its own: what was lowered before would be taken again.
    traced = jax.jit(lambda *x: function(*x)).trace(*arguments)
    return traced.lower(lowering_platforms=platforms).as_text()


def launches_in(text):
    """How many kernels a lowered program calls."""
    return text.count("custom_call @onekernel_") + text.count(f"custom_call @{gpu._TARGET}")


def launches(function, *arguments, platforms=None):
    """How many kernels a program calls on the platform that it is lowered for."""
    return launches_in(lowered_text(function, *arguments, platforms=platforms))
