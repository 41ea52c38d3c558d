"""Launch the kernels of PPO on CPUs, of which one computes a whole update."""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jetbot_mjx.agents.fused import adam
from jetbot_mjx.agents.fused.adam import AdamRule
from jetbot_mjx.agents.fused.arrays import Arrays, minibatch_of
from jetbot_mjx.agents.fused.cpu_actions import ActionDivision, action_call
from jetbot_mjx.agents.fused.cpu_adam import adam_call
from jetbot_mjx.agents.fused.cpu_gradient import divisions, gradient_call
from jetbot_mjx.agents.fused.cpu_network import HEAD
from jetbot_mjx.agents.fused.cpu_stages import Call
from jetbot_mjx.agents.fused.cpu_unroll import Unroll, unroll_call
from jetbot_mjx.agents.fused.cpu_update import update_call
from jetbot_mjx.agents.fused.shapes import Minibatch, UpdateShape
from onekernel.build import Backend, cpu, in_background

BACKEND: Backend = cpu
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
    # Whether there is a compiler at all, and then the sizes that the stages can take.
    if obstacle := cpu.obstacle():
        return obstacle
    outputs = max(shape.outputs)
    if outputs > HEAD:
        return f"it takes at most {HEAD} outputs, not {outputs}"
    if shape.width % _WIDTH_STEP:
        return f"it takes layers of 16, 32, 48, ... units, not {shape.width}"
    lanes = cpu.host_processor().lanes
    if max(4 * x.layout["size"] for x in divisions(shape, batch, lanes)) > _MOST_MEMORY:
        return f"unrolls of {batch.time} steps do not fit in {_MOST_MEMORY >> 20} MiB"
    return None


def _write(host: cpu.Host, write: Callable[..., Call], *given: Any) -> str:
    """Write the LLVM module of a call.

    Args:
      host: the processor.
      write: a function that returns the call.
      *given: its arguments before the number of lanes.
    """
    return write(*given, host.lanes).text(
        lanes=host.lanes, registers=host.registers, machine=host.machine
    )


_text = functools.cache(_write)


def _unroll_text(host: cpu.Host, write: Callable[..., Call], *given: Any) -> str:
    """Return the LLVM module of an unroll, which is kept with the kernel of its environment."""
    # The name needs no kernel, for it is the kernel that keeps the text.
    unroll, *sizes = given
    name = repr((*unroll._replace(kernel=None), *sizes, host))
    return unroll.kernel.text(name, lambda: _write(host, write, *given))


def _action_call(shape: UpdateShape, environments: int, lanes: int) -> Call:
    return action_call(ActionDivision(shape, environments, lanes))


def prepare(
    rule: AdamRule, batch: Minibatch, environments: int, policies: int, *, at_once: bool
) -> None:
    """Begin to compile all kernels, which serve any number of policies, as `launch.prepare`."""
    # One call for all minibatches, or two for each.
    calls: list[tuple[Any, ...]] = [(gradient_call, rule.shape, batch), (adam_call, rule)]
    if at_once:
        calls = [(update_call, rule, batch)]
    host = cpu.host_processor()
    for call in calls:
        in_background(lambda call=call: cpu.registered(_text(host, *call)))


def prepare_unroll(unroll: Unroll, environments: int, time: int) -> None:
    """Begin to compile an unroll, as `launch.prepare_unroll`."""
    host, given = cpu.host_processor(), (unroll, environments, time)
    in_background(lambda: cpu.registered(_unroll_text(host, unroll_call, *given)))


def _launch(
    arrays: Arrays,
    write: Callable[..., Call],
    *given: Any,
    updated: Sequence[str] = (),
    text: Callable[..., str] = _text,
) -> list[Array]:
    """Call a function, while JAX lowers a program for CPUs.

    Args:
      arrays: its arguments, of which the first one has the policies as its first axis.
      write: a function that returns the call.
      *given: its arguments before the number of lanes.
      updated: the names of the arguments that it changes, and returns before other results.
      text: a function of the processor, `write` and what it is given that returns the LLVM module.

    Returns:
      Its results and its scratch memory, of shape (policies, numbers) unless they are arguments.
    """
    host, (first, *_) = cpu.host_processor(), arrays.values()
    # Results are as long as the call says, but for those that take the place of arguments.
    call = write(*given, host.lanes)
    shapes: list[tuple[int, ...]] = [(first.shape[0], call.sizes[name]) for name in call.results]
    shapes[: len(updated)] = [arrays[name].shape for name in updated]
    like = [jax.ShapeDtypeStruct(shape, np.float32) for shape in shapes]
    # XLA is told by number which arguments these are.
    aliases = {list(arrays).index(name): i for i, name in enumerate(updated)}
    return cpu.launch_text(text(host, write, *given), list(arrays.values()), like, aliases)


# The kernels by name. What describes a kernel comes first, then its arguments.


def _launch_actions(shape: UpdateShape, arrays: Arrays) -> list[Array]:
    return _launch(arrays, _action_call, shape, arrays["observations"].shape[1])


def _launch_unroll(unroll: Unroll, arrays: Arrays) -> list[Array]:
    _, time, environments, _ = arrays["unroll_noise"].shape
    return _launch(arrays, unroll_call, unroll, environments, time, text=_unroll_text)


def _launch_gradient(shape: UpdateShape, arrays: Arrays) -> list[Array]:
    return _launch(arrays, gradient_call, shape, minibatch_of(arrays))


def _launch_adam(rule: AdamRule, arrays: Arrays) -> list[Array]:
    return _launch(arrays, adam_call, rule, updated=adam.UPDATED)


def _launch_update(rule: AdamRule, arrays: Arrays) -> list[Array]:
    return _launch(arrays, update_call, rule, minibatch_of(arrays), updated=adam.UPDATED)


LAUNCHES: Mapping[str, Callable[[Any, Arrays], list[Array]]] = {
    "actions": _launch_actions,
    "unroll": _launch_unroll,
    "gradient": _launch_gradient,
    "adam": _launch_adam,
    "update": _launch_update,
}
"""The kernels, as in `launch.Launcher`."""
