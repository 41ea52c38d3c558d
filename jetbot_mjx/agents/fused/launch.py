"""Run the kernels of PPO as JAX functions, which `jax.vmap` batches over seeds.

Their arguments are arrays of `arrays`, in the order of each kernel's signature there.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused import arrays, launch_cpu, launch_gpu
from jetbot_mjx.agents.fused.adam import AdamRule
from jetbot_mjx.agents.fused.arrays import Actions, Arrays, Signature
from jetbot_mjx.agents.fused.cpu_unroll import Unroll
from jetbot_mjx.agents.fused.shapes import Minibatch, UpdateShape
from onekernel.build import Backend, make_primitive


class Launcher(Protocol):
    """A `Launcher` launches the kernels on one kind of device."""

    BACKEND: Backend
    """The back end that compiles the kernels."""
    LAUNCHES: Mapping[str, Callable[[Any, Arrays], list[Array]]]
    """The kernels by the name of their signature: functions that JAX calls while it lowers a
    program, from what describes the kernel and its arguments, with one axis of policies in front,
    to arrays that begin with the numbers of the results, whatever their shape."""

    def refusal(self, shape: UpdateShape, batch: Minibatch) -> str | None:
        """Return why this process cannot run the kernels, or None."""

    def prepare(
        self, rule: AdamRule, batch: Minibatch, environments: int, policies: int, *, at_once: bool
    ) -> None:
        """Begin to compile the kernels, as `launch.prepare`."""


_LAUNCHERS: dict[str, Launcher] = {"gpu": launch_gpu, "cpu": launch_cpu}
"""The modules that launch the kernels, by the kind of JAX's default device."""


def _has(kernel: Signature) -> bool:
    launcher = _LAUNCHERS.get(jax.default_backend())
    return launcher is not None and kernel.name in launcher.LAUNCHES


def backend() -> Backend:
    """Return the back end that compiles the kernels for JAX's default device."""
    return _LAUNCHERS[jax.default_backend()].BACKEND


def refusal(shape: UpdateShape, batch: Minibatch) -> str | None:
    """Return why this process cannot run the kernels, or None.

    Args:
      shape: the networks.
      batch: the minibatch.
    """
    # Other devices have no kernels; on those that have, not every network fits.
    launcher = _LAUNCHERS.get(jax.default_backend())
    if launcher is None:
        return f"it needs a CPU or an NVIDIA GPU, and this is {jax.default_backend()}"
    return launcher.refusal(shape, batch)


def computes_at_once() -> bool:
    """Return whether one kernel computes all minibatches on JAX's default device: `update`."""
    return _has(arrays.UPDATE)


def unrolls_at_once() -> bool:
    """Return whether one kernel computes an unroll on JAX's default device: `unroll`."""
    return _has(arrays.UNROLL)


def prepare(
    rule: AdamRule, batch: Minibatch, environments: int, policies: int, *, at_once: bool
) -> None:
    """Begin to compile the kernels, before a program is traced that launches them.

    Args:
      rule: the networks, and how the step size changes.
      batch: the minibatch.
      environments: the number of environments of a policy.
      policies: the number of policies that are trained at once.
      at_once: whether `update` is what it launches, and not `gradient` and `adam`.
    """
    launcher = _LAUNCHERS[jax.default_backend()]
    launcher.prepare(rule, batch, environments, policies, at_once=at_once)


def prepare_unroll(spec: Unroll, environments: int, time: int) -> None:
    """Begin to compile the kernel of `unroll`, which only CPUs have.

    Args:
      spec: the networks and the environment.
      environments: the number of environments.
      time: the number of steps.
    """
    launch_cpu.prepare_unroll(spec, environments, time)


def actions(shape: UpdateShape, *given: Array) -> Actions:
    """Run the policy network and draw actions.

    Args:
      shape: the networks.
      *given: the arguments of `arrays.ACTIONS`.
    """
    return Actions(*_actions_p.bind(*given, spec=shape))


def unroll(
    spec: Unroll, *given: Array
) -> tuple[Float[Array, "environments state"], Float[Array, "time environments kept"], Actions]:
    """Draw actions and step the environments with them, again and again.

    Args:
      spec: the networks and the environment.
      *given: the arguments of `arrays.UNROLL`.

    Returns:
      The states after the last step; what is kept of the states after each step; and the actions
      of all steps.
    """
    end, kept, *drawn = _unroll_p.bind(*given, spec=spec)
    return end, kept, Actions(*drawn)


def gradient(shape: UpdateShape, *given: Array) -> Float[Array, " size"]:
    """Compute the gradient of PPO's loss by the parameters of both networks.

    Args:
      shape: the networks.
      *given: the arguments of `arrays.GRADIENT`.

    Returns:
      The gradient, with the sums of the metrics at their places.
    """
    return _gradient_p.bind(*given, spec=shape)[0]


def adam(rule: AdamRule, *given: Array) -> tuple[Array, Array, Array, Array]:
    """Make a step of Adam, whose equations are in `jetbot_mjx.agents.fused.adam`.

    Args:
      rule: what the vectors hold, and how the step size changes.
      *given: the arguments of `arrays.ADAM`.

    Returns:
      The next parameters, means and progress.
    """
    params, mu, nu, progress = _adam_p.bind(*given, spec=rule)
    return params, mu, nu, progress


def update(rule: AdamRule, *given: Array) -> tuple[Array, Array, Array, Array]:
    """Make a step of Adam along the gradient of each minibatch, as `gradient` and `adam` do.

    Args:
      rule: the networks, and how the step size changes.
      *given: the arguments of `arrays.UPDATE`.

    Returns:
      The parameters, means and progress after the last minibatch.
    """
    params, mu, nu, progress = _update_p.bind(*given, spec=rule)
    return params, mu, nu, progress


def _primitive(kernel: Signature) -> Primitive:
    """Return the primitive of a kernel, which the launchers lower."""
    primitive = make_primitive(f"ppo_{kernel.name}", "spec")

    # The shapes, for any number of policies.
    @primitive.def_abstract_eval
    def abstract(*given: Any, spec: Any) -> list[ShapedArray]:
        return [ShapedArray(shape, np.float32) for shape in kernel.results(spec, given)]

    def lowered_by(launch: Callable[[Any, Arrays], list[Array]]) -> Callable[..., list[Array]]:
        def lowered(*given: Array, spec: Any) -> list[Array]:
            # One axis of policies. XLA would copy what is changed in place if it had another shape.
            batch = given[0].shape[:-1]
            flat = {
                name: x
                if name in kernel.updated
                else x.reshape(math.prod(batch), *x.shape[len(batch) :])
                for name, x in zip(kernel.arguments, given, strict=True)
            }
            # Behind the results there may be scratch memory.
            shapes = kernel.results(spec, given)
            made = zip(launch(spec, flat), shapes, strict=False)
            return [x.reshape(shape) for x, shape in made]

        return lowered

    # For every platform that has the kernel, whatever the default device is.
    for launcher in _LAUNCHERS.values():
        if launch := launcher.LAUNCHES.get(kernel.name):
            lowering = mlir.lower_fun(lowered_by(launch))
            mlir.register_lowering(primitive, lowering, platform=launcher.BACKEND.PLATFORM)
    return primitive


# The kernels as JAX sees them.
_actions_p = _primitive(arrays.ACTIONS)
_unroll_p = _primitive(arrays.UNROLL)
_gradient_p = _primitive(arrays.GRADIENT)
_adam_p = _primitive(arrays.ADAM)
_update_p = _primitive(arrays.UPDATE)
