"""Run the kernels of PPO as JAX functions, which `jax.vmap` batches over policies.

Their arguments are arrays of `arrays`, in the order of each kernel's signature there.
"""

import functools
from collections.abc import Collection, Sequence
from typing import Protocol

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused import arrays, launch_cpu, launch_gpu
from jetbot_mjx.agents.fused.adam import AdamRule
from jetbot_mjx.agents.fused.arrays import Actions, Arrays, Signature, Spec
from jetbot_mjx.agents.fused.shapes import Minibatch, Unroll, UpdateShape
from onekernel.build import Backend, make_primitive


class Launcher(Protocol):
    """A `Launcher` launches the kernels on one kind of device."""

    BACKEND: Backend
    """The back end that compiles the kernels."""

    NAMES: Collection[str]
    """Names of the signatures of its kernels."""

    def refusal(self, shape: UpdateShape, batch: Minibatch) -> str | None:
        """Return why this process cannot run the kernels, or None."""

    def prepare(self, kernel: Signature, spec: Spec, batch: Minibatch, policies: int) -> None:
        """Begin to compile a kernel, as `launch.prepare`, by the relevant part of the data."""

    def launch(
        self, kernel: Signature, spec: Spec, batch: Minibatch, arrays: Arrays
    ) -> list[Array]:
        """Launch a kernel, while JAX lowers a program.

        Args:
          kernel: the kernel.
          spec: what it is written for.
          batch: the data, from `Signature.batch_of`.
          arrays: the arguments, with one axis of policies in front.

        Returns:
          Arrays that begin with the numbers of the results, whatever their shape, and then others.
        """
        ...


_LAUNCHERS: dict[str, Launcher] = {"gpu": launch_gpu, "cpu": launch_cpu}
"""The modules that launch the kernels, by the kind of JAX's default device."""


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


def has(kernel: Signature) -> bool:
    """Return whether JAX's default device has a kernel."""
    launcher = _LAUNCHERS.get(jax.default_backend())
    return launcher is not None and kernel.name in launcher.NAMES


def prepare(kernel: Signature, spec: Spec, batch: Minibatch, policies: int = 1) -> None:
    """Begin to compile a kernel, before a program is traced that launches it.

    Args:
      kernel: the kernel.
      spec: the description for which it is written.
      batch: how much data a policy has.
      policies: the number of policies that are trained at once.
    """
    launcher = _LAUNCHERS[jax.default_backend()]
    launcher.prepare(kernel, spec, kernel.relevant(batch), policies)


def actions(shape: UpdateShape, *given: Array) -> Actions:
    """Run the policy network and draw actions.

    Args:
      shape: the networks.
      *given: the arguments of `arrays.ACTIONS`.
    """
    return Actions(*_PRIMITIVES["actions"].bind(*given, spec=shape))


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
    end, kept, *drawn = _PRIMITIVES["unroll"].bind(*given, spec=spec)
    return end, kept, Actions(*drawn)


def gradient(shape: UpdateShape, *given: Array) -> Float[Array, " size"]:
    """Compute the gradient of PPO's loss by the parameters of both networks.

    Args:
      shape: the networks.
      *given: the arguments of `arrays.GRADIENT`.

    Returns:
      The gradient, with the sums of the metrics at their places.
    """
    return _PRIMITIVES["gradient"].bind(*given, spec=shape)[0]


def adam(rule: AdamRule, *given: Array) -> tuple[Array, ...]:
    """Make a step of Adam, whose equations are in `jetbot_mjx.agents.fused.adam`.

    Args:
      rule: what the vectors hold, and how the step size changes.
      *given: the arguments of `arrays.ADAM`.

    Returns:
      The next parameters, means and progress.
    """
    return tuple(_PRIMITIVES["adam"].bind(*given, spec=rule))


def update(rule: AdamRule, *given: Array) -> tuple[Array, ...]:
    """Make a step of Adam along the gradient of each minibatch, as `gradient` and `adam` do.

    Args:
      rule: the networks, and how the step size changes.
      *given: the arguments of `arrays.UPDATE`.

    Returns:
      The parameters, means and progress after the last minibatch.
    """
    return tuple(_PRIMITIVES["update"].bind(*given, spec=rule))


def _primitive(kernel: Signature) -> Primitive:
    """Return the primitive of a kernel, which the launchers lower."""
    primitive = make_primitive(f"ppo_{kernel.name}", "spec")

    def result_shapes(given: Sequence[Array | ShapedArray], spec: Spec) -> list[tuple[int, ...]]:
        shapes, batch = kernel.shapes(spec, kernel.batch_of(spec, given)), given[0].shape[:-1]
        return [(*batch, *shapes[name]) for name in kernel.returns]

    # The shapes, for any number of policies.
    @primitive.def_abstract_eval
    def abstract(*given: ShapedArray, spec: Spec) -> list[ShapedArray]:
        return [ShapedArray(shape, np.float32) for shape in result_shapes(given, spec)]

    def lowered(launcher: Launcher, *given: Array, spec: Spec) -> list[Array]:
        # One axis of policies. XLA would copy what is changed in place if it had another shape.
        batch = given[0].shape[:-1]
        flat = {
            name: x if name in kernel.returns else x.reshape(-1, *x.shape[len(batch) :])
            for name, x in zip(kernel.arguments, given, strict=True)
        }
        made = launcher.launch(kernel, spec, kernel.batch_of(spec, given), flat)
        # Behind the results there may be scratch memory.
        shapes = result_shapes(given, spec)
        return [x.reshape(shape) for x, shape in zip(made, shapes, strict=False)]

    # For every platform that has the kernel, whatever the default device is.
    for launcher in _LAUNCHERS.values():
        if kernel.name in launcher.NAMES:
            rule = mlir.lower_fun(functools.partial(lowered, launcher))
            mlir.register_lowering(primitive, rule, platform=launcher.BACKEND.PLATFORM)
    return primitive


_PRIMITIVES = {
    kernel.name: _primitive(kernel)
    for kernel in (arrays.ACTIONS, arrays.UNROLL, arrays.GRADIENT, arrays.ADAM, arrays.UPDATE)
}
"""The kernels as JAX sees them."""
