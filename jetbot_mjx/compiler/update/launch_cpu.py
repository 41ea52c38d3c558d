"""Launch the kernels of PPO on CPUs.

The value network's kernel of the gradient also returns the advantages, which that of the policy
takes. Each part of a minibatch writes a vector, and XLA adds them up in a fixed order.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jetbot_mjx.compiler import llvm_backend
from jetbot_mjx.compiler.background import in_background
from jetbot_mjx.compiler.kernel import Backend
from jetbot_mjx.compiler.update import adam
from jetbot_mjx.compiler.update.adam import AdamRule
from jetbot_mjx.compiler.update.cpu_actions import ActionDivision, ActionKernel
from jetbot_mjx.compiler.update.cpu_adam import adam_text
from jetbot_mjx.compiler.update.cpu_gradient import GradientDivision, gradient_kernel
from jetbot_mjx.compiler.update.cpu_network import HEAD, Division, Kernel
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
    if outputs > HEAD:
        return f"it takes at most {HEAD} outputs, not {outputs}"
    if shape.width % _WIDTH_STEP:
        return f"it takes layers of 16, 32, 48, ... units, not {shape.width}"
    if max(4 * x.layout["size"] for x in _divisions(shape, batch)) > _MOST_MEMORY:
        return f"unrolls of {batch.time} steps do not fit in {_MOST_MEMORY >> 20} MiB"
    return None


def _divisions(shape: UpdateShape, batch: Minibatch) -> tuple[GradientDivision, GradientDivision]:
    """Return how the values' kernel and the policy's kernel divide a minibatch."""
    lanes = llvm_backend.host_processor().lanes
    values, policy = (GradientDivision(shape, batch, x, lanes) for x in (False, True))
    return values, policy


@functools.cache
def _text(kernel: Callable[[Any], Kernel], division: Division) -> str:
    """Return the LLVM module of a kernel."""
    host = llvm_backend.host_processor()
    return kernel(division).text(
        registers=host.registers, name=llvm_backend.NAME, machine=host.machine
    )


@functools.cache
def _adam_text(rule: AdamRule) -> str:
    host = llvm_backend.host_processor()
    return adam_text(rule, host.lanes, name=llvm_backend.NAME, machine=host.machine)


def prepare(rule: AdamRule, batch: Minibatch, environments: int, policies: int) -> None:
    """Begin to compile all kernels, which serve any number of policies, as `launch.prepare`."""
    shape, lanes = rule.shape, llvm_backend.host_processor().lanes
    texts = [functools.partial(_text, ActionKernel, ActionDivision(shape, environments, lanes))]
    texts += [functools.partial(_text, gradient_kernel, x) for x in _divisions(shape, batch)]
    texts.append(functools.partial(_adam_text, rule))
    for text in texts:
        in_background(lambda text=text: llvm_backend.registered(text()))


def launch_actions(shape: UpdateShape, arguments: Sequence[Array]) -> list[Array]:
    """Draw actions, while JAX lowers a program for CPUs.

    Args:
      shape: the networks.
      arguments: those of `launch.actions`, with the policies as their first axis.

    Returns:
      The arrays of `launch.Actions`.
    """
    policies, environments = arguments[3].shape[:2]
    division = ActionDivision(shape, environments, llvm_backend.host_processor().lanes)
    like = [
        jax.ShapeDtypeStruct((policies, *sizes), np.float32)
        for sizes in shape.drawn_shapes(environments)
    ]
    return llvm_backend.launch_text(_text(ActionKernel, division), arguments, like)


def launch_gradient(shape: UpdateShape, arguments: Sequence[Array]) -> list[Array]:
    """Run both kernels of a minibatch, while JAX lowers a program for CPUs.

    Args:
      shape: the networks.
      arguments: those of `launch.gradient`, with the policies as their first axis.

    Returns:
      The gradients, with the sums of the metrics at their places, as the only array.
    """
    params, mean, scale, rows, last, unrolls, noise, index, terms = arguments
    policies, count, each = unrolls.shape
    batch = Minibatch(rows.shape[1], each, rows.shape[2], count)
    values, policy = _divisions(shape, batch)

    def floats(*sizes: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((policies, *sizes), np.float32)

    def run(division: GradientDivision, others: Sequence[Array], *results: int) -> list[Array]:
        like = [floats(division.parts, division.size), *map(floats, results)]
        given = [params, mean, scale, rows, unrolls, index, terms, *others]
        vectors, *rest = llvm_backend.launch_text(_text(gradient_kernel, division), given, like)
        # XLA's own reduction takes longer than a part does.
        total = functools.reduce(jnp.add, [vectors[:, i] for i in range(division.parts)])
        return [total, *rest]

    of_values, advantages = run(values, [last], batch.samples)
    (of_policy,) = run(policy, [noise, advantages])
    return [jnp.concatenate([of_policy, of_values], axis=1)]


def launch_adam(rule: AdamRule, arguments: Sequence[Array]) -> list[Array]:
    """Make a step of Adam, while JAX lowers a program for CPUs.

    Args:
      rule: what the vectors hold.
      arguments: those of `launch.adam`; the first one has the policies as its first axis.

    Returns:
      Its results, in place of the arguments.
    """
    like = [jax.ShapeDtypeStruct(arguments[i].shape, np.float32) for i in adam.ALIASES]
    return llvm_backend.launch_text(_adam_text(rule), arguments, like, adam.ALIASES)
