"""Launch the kernels of PPO's update on CPUs.

The kernel of the value network also returns the advantages, which that of the policy takes. Each
part of a minibatch writes a vector, and XLA adds them up in a fixed order.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jetbot_mjx.compiler import llvm_backend
from jetbot_mjx.compiler.background import in_background
from jetbot_mjx.compiler.kernel import Backend
from jetbot_mjx.compiler.update import cpu_kernels
from jetbot_mjx.compiler.update.cpu_kernels import Division
from jetbot_mjx.compiler.update.shapes import Minibatch, UpdateShape

BACKEND: Backend = llvm_backend
"""The back end that compiles the kernels."""

_WIDTH_STEP = 16
_MOST_MEMORY = 4 << 20
"""Bytes of scratch memory of a part; what it works with should stay in the processor's cache."""


def refusal(shape: UpdateShape, batch: Minibatch) -> str | None:
    """Return why the CPUs of this process cannot run the kernels, or None.

    Args:
      shape: the networks.
      batch: the minibatch.
    """
    if not llvm_backend.is_available():
        return f"it needs {llvm_backend.NEEDS}"
    outputs = max(shape.outputs)
    if outputs > cpu_kernels.HEAD:
        return f"it takes at most {cpu_kernels.HEAD} outputs, not {outputs}"
    if shape.width % _WIDTH_STEP:
        return f"it takes layers of 16, 32, 48, ... units, not {shape.width}"
    if max(4 * x.layout["size"] for x in _divisions(shape, batch)) > _MOST_MEMORY:
        return f"unrolls of {batch.time} steps do not fit in {_MOST_MEMORY >> 20} MiB"
    return None


def _divisions(shape: UpdateShape, batch: Minibatch) -> tuple[Division, Division]:
    """Return how the values' kernel and the policy's kernel divide a minibatch."""
    lanes = llvm_backend.host_processor().lanes
    return Division(shape, batch, False, lanes), Division(shape, batch, True, lanes)


@functools.cache
def _text(division: Division) -> str:
    """Return the LLVM module of a kernel."""
    host = llvm_backend.host_processor()
    return cpu_kernels.kernel_text(
        division, registers=host.registers, name=llvm_backend.NAME, machine=host.machine
    )


def prepare(shape: UpdateShape, batch: Minibatch, policies: int) -> None:
    """Begin to compile both kernels, which serve any number of policies, as `launch.prepare`."""
    for division in _divisions(shape, batch):
        in_background(lambda division=division: llvm_backend.registered(_text(division)))


def launch(shape: UpdateShape, arguments: Sequence[Array]) -> Float[Array, "policies size"]:
    """Run both kernels, while JAX lowers a program for CPUs.

    Args:
      shape: the networks.
      arguments: those of `launch.gradient`, with the policies as their first axis.

    Returns:
      The gradients, with the sums of the metrics at their places.
    """
    params, mean, scale, rows, last, unrolls, noise, terms = arguments
    policies = params.shape[0]
    batch = Minibatch(rows.shape[1], unrolls.shape[1], rows.shape[2])
    values, policy = _divisions(shape, batch)

    def floats(*sizes: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((policies, *sizes), np.float32)

    def run(division: Division, others: Sequence[Array], *results: int) -> list[Array]:
        like = [floats(division.parts, division.size), *map(floats, results)]
        given = [params, mean, scale, rows, unrolls, terms, *others]
        vectors, *rest = llvm_backend.launch_text(_text(division), given, like)
        # XLA's own reduction takes longer than a part does.
        total = functools.reduce(jnp.add, [vectors[:, i] for i in range(division.parts)])
        return [total, *rest]

    of_values, advantages = run(values, [last], batch.samples)
    (of_policy,) = run(policy, [noise, advantages])
    return jnp.concatenate([of_policy, of_values], axis=1)
