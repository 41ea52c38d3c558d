"""Launch the kernels of PPO on CPUs, of which one computes a whole update."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jetbot_mjx.compiler import llvm_backend
from jetbot_mjx.compiler.background import in_background
from jetbot_mjx.compiler.kernel import Backend
from jetbot_mjx.compiler.update import adam
from jetbot_mjx.compiler.update.adam import AdamRule
from jetbot_mjx.compiler.update.cpu_actions import ActionDivision, action_call
from jetbot_mjx.compiler.update.cpu_adam import adam_call
from jetbot_mjx.compiler.update.cpu_gradient import divisions, gradient_call
from jetbot_mjx.compiler.update.cpu_network import HEAD
from jetbot_mjx.compiler.update.cpu_stages import Call
from jetbot_mjx.compiler.update.cpu_unroll import Unroll, unroll_call
from jetbot_mjx.compiler.update.cpu_update import ALIASES, update_call
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
    if obstacle := llvm_backend.obstacle():
        return obstacle
    outputs = max(shape.outputs)
    if outputs > HEAD:
        return f"it takes at most {HEAD} outputs, not {outputs}"
    if shape.width % _WIDTH_STEP:
        return f"it takes layers of 16, 32, 48, ... units, not {shape.width}"
    lanes = llvm_backend.host_processor().lanes
    if max(4 * x.layout["size"] for x in divisions(shape, batch, lanes)) > _MOST_MEMORY:
        return f"unrolls of {batch.time} steps do not fit in {_MOST_MEMORY >> 20} MiB"
    return None


def _write(host: llvm_backend.Host, write: Callable[..., Call], *given: Any) -> str:
    """Write the LLVM module of a call.

    Args:
      host: the processor.
      write: a function that returns the call.
      *given: its arguments before the number of lanes.
    """
    return write(*given, host.lanes).text(
        lanes=host.lanes, registers=host.registers, name=llvm_backend.NAME, machine=host.machine
    )


_text = functools.cache(_write)


def _unroll_text(host: llvm_backend.Host, write: Callable[..., Call], *given: Any) -> str:
    """Return the LLVM module of an unroll, which is kept with the kernel of its environment."""
    unroll, *sizes = given
    name = repr((*unroll._replace(kernel=None), *sizes, host))
    return unroll.kernel.text(name, lambda: _write(host, write, *given))


def _action_call(shape: UpdateShape, environments: int, lanes: int) -> Call:
    return action_call(ActionDivision(shape, environments, lanes))


def prepare(
    rule: AdamRule, batch: Minibatch, environments: int, policies: int, *, at_once: bool
) -> None:
    """Begin to compile all kernels, which serve any number of policies, as `launch.prepare`."""
    calls: list[tuple[Any, ...]] = [(gradient_call, rule.shape, batch), (adam_call, rule)]
    if at_once:
        calls = [(update_call, rule, batch)]
    host = llvm_backend.host_processor()
    for call in calls:
        in_background(lambda call=call: llvm_backend.registered(_text(host, *call)))


def prepare_unroll(unroll: Unroll, environments: int, time: int) -> None:
    """Begin to compile an unroll, as `launch.prepare_unroll`."""
    host, given = llvm_backend.host_processor(), (unroll, environments, time)
    in_background(lambda: llvm_backend.registered(_unroll_text(host, unroll_call, *given)))


def _launch(
    arguments: Sequence[Array],
    policies: int,
    write: Callable[..., Call],
    *given: Any,
    aliases: Mapping[int, int] | None = None,
    text: Callable[..., str] = _text,
) -> list[Array]:
    """Call a function, while JAX lowers a program for CPUs.

    Args:
      arguments: its arrays.
      policies: the number of policies.
      write: a function that returns the call.
      *given: its arguments before the number of lanes.
      aliases: which arguments it changes, and as which results it returns them.
      text: a function of the processor, `write` and what it is given that returns the LLVM module.

    Returns:
      Its results, of shape (policies, numbers) unless they are arguments.
    """
    host = llvm_backend.host_processor()
    call = write(*given, host.lanes)
    shapes: list[tuple[int, ...]] = [(policies, call.sizes[name]) for name in call.results]
    for argument, result in (aliases or {}).items():
        shapes[result] = arguments[argument].shape
    like = [jax.ShapeDtypeStruct(shape, np.float32) for shape in shapes]
    return llvm_backend.launch_text(text(host, write, *given), arguments, like, aliases)


def launch_actions(shape: UpdateShape, arguments: Sequence[Array]) -> list[Array]:
    """Draw actions, while JAX lowers a program for CPUs.

    Args:
      shape: the networks.
      arguments: those of `launch.actions`, with the policies as their first axis.

    Returns:
      The arrays of `launch.Actions`.
    """
    policies, environments = arguments[3].shape[:2]
    drawn = _launch(arguments, policies, _action_call, shape, environments)
    shapes = shape.drawn_shapes(environments)
    return [x.reshape(policies, *sizes) for x, sizes in zip(drawn, shapes, strict=True)]


def launch_unroll(unroll: Unroll, arguments: Sequence[Array]) -> list[Array]:
    """Take all environments through an unroll, while JAX lowers a program for CPUs.

    Args:
      unroll: the networks and the environment.
      arguments: those of `launch.unroll`, with the policies as their first axis.

    Returns:
      The last states, what is kept of all states, and the arrays of `launch.Actions`.
    """
    policies, time, environments, _ = arguments[4].shape
    given = unroll_call, unroll, environments, time
    end, *steps = _launch(arguments, policies, *given, text=_unroll_text)
    shapes = [(environments, len(unroll.kept)), *unroll.shape.drawn_shapes(environments)]
    return [
        end.reshape(policies, environments, unroll.state),
        *(x.reshape(policies, time, *each) for x, each in zip(steps, shapes, strict=True)),
    ]


def launch_gradient(shape: UpdateShape, arguments: Sequence[Array]) -> list[Array]:
    """Compute the gradient of a minibatch, while JAX lowers a program for CPUs.

    Args:
      shape: the networks.
      arguments: those of `launch.gradient`, with the policies as their first axis.

    Returns:
      The gradients, with the sums of the metrics at their places, as the only array.
    """
    rows, unrolls = arguments[3], arguments[5]
    policies, count, each = unrolls.shape
    batch = Minibatch(rows.shape[1], each, rows.shape[2], count)
    return _launch(arguments, policies, gradient_call, shape, batch)[:1]


def launch_adam(rule: AdamRule, arguments: Sequence[Array]) -> list[Array]:
    """Make a step of Adam, while JAX lowers a program for CPUs.

    Args:
      rule: what the vectors hold.
      arguments: those of `launch.adam`; the first one has the policies as its first axis.

    Returns:
      Its results, in place of the arguments.
    """
    made = _launch(arguments, arguments[0].shape[0], adam_call, rule, aliases=adam.ALIASES)
    return made[: len(adam.ALIASES)]


def launch_update(rule: AdamRule, arguments: Sequence[Array]) -> list[Array]:
    """Compute all minibatches, while JAX lowers a program for CPUs.

    Args:
      rule: the networks, and how the step size changes.
      arguments: those of `launch.update`, of which those that it does not change have the policies
        as their first axis.

    Returns:
      Its results, in place of the arguments.
    """
    rows, unrolls = arguments[2], arguments[4]
    policies, count, each = unrolls.shape
    batch = Minibatch(rows.shape[1], each, rows.shape[2], count)
    made = _launch(arguments, policies, update_call, rule, batch, aliases=ALIASES)
    return made[: len(ALIASES)]
