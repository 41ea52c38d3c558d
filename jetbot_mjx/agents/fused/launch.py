"""Run the kernels of PPO as JAX functions, which `jax.vmap` batches over replicas (see `arrays`).

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
from jetbot_mjx.agents.fused.shapes import DataSizes, UnrollSpec, UpdateShape
from onekernel.build import Backend, make_primitive


class Launcher(Protocol):
    """A `Launcher` launches the kernels on one kind of device."""

    BACKEND: Backend
    """The back end that compiles the kernels."""

    NAMES: Collection[str]
    """Names of the signatures of its kernels."""

    def refusal(self, shape: UpdateShape, batch: DataSizes) -> str | None:
        """Return why this process cannot run the kernels, or None."""

    def prepare(self, kernel: Signature, spec: Spec, batch: DataSizes, replicas: int) -> None:
        """Begin to compile a kernel, as `launch.prepare`, by the relevant part of the data."""

    def launch(
        self, kernel: Signature, spec: Spec, batch: DataSizes, arrays: Arrays
    ) -> list[Array]:
        """Launch a kernel, while JAX lowers a program.

        Args:
          kernel: the kernel.
          spec: what it is written for.
          batch: the data, from `Signature.batch_of`.
          arrays: the arguments, with one axis of replicas in front.

        Returns:
          The results, each in any shape that has its numbers in their order, and behind them any
          arrays that the kernel worked with.
        """
        ...


_LAUNCHERS: dict[str, Launcher] = {"gpu": launch_gpu, "cpu": launch_cpu}
"""The modules that launch the kernels, by JAX's name of a platform."""


def backend() -> Backend:
    """Return the back end that compiles the kernels for JAX's default platform."""
    return _LAUNCHERS[jax.default_backend()].BACKEND


def refusal(shape: UpdateShape, batch: DataSizes) -> str | None:
    """Return why this process cannot run the kernels, or None.

    Args:
      shape: the networks.
      batch: the minibatch.
    """
    # Other platforms have no kernels; on those that have, not every network fits.
    launcher = _LAUNCHERS.get(jax.default_backend())
    if launcher is None:
        return f"it needs a CPU or an NVIDIA GPU, and this is {jax.default_backend()}"
    return launcher.refusal(shape, batch)


def has(kernel: Signature) -> bool:
    """Return whether JAX's default platform has a kernel."""
    launcher = _LAUNCHERS.get(jax.default_backend())
    return launcher is not None and kernel.name in launcher.NAMES


def prepare(kernel: Signature, spec: Spec, batch: DataSizes, replicas: int = 1) -> None:
    """Begin to compile a kernel, before a program is traced that launches it.

    Args:
      kernel: the kernel.
      spec: the description for which it is written.
      batch: the sizes of the data.
      replicas: the number of trainings that run at once.
    """
    launcher = _LAUNCHERS[jax.default_backend()]
    launcher.prepare(kernel, spec, kernel.relevant(batch), replicas)


def actions(shape: UpdateShape, *arguments: Array) -> Actions:
    """Run the policy network and draw actions.

    Args:
      shape: the networks.
      *arguments: those of `arrays.ACTIONS`.
    """
    return Actions(*_PRIMITIVES["actions"].bind(*arguments, spec=shape))


def unroll(
    spec: UnrollSpec, *arguments: Array
) -> tuple[Float[Array, "environments state"], Float[Array, "time environments kept"], Actions]:
    """Draw actions and step the environments with them, again and again.

    Args:
      spec: the networks and the environment.
      *arguments: those of `arrays.UNROLL`.

    Returns:
      The states after the last step; what is kept of the states after each step; and the actions
      of all steps.
    """
    end, kept, *actions = _PRIMITIVES["unroll"].bind(*arguments, spec=spec)
    return end, kept, Actions(*actions)


def gradient(shape: UpdateShape, *arguments: Array) -> Float[Array, " size"]:
    """Compute the gradient of PPO's loss with respect to the parameters of both networks.

    Args:
      shape: the networks.
      *arguments: those of `arrays.GRADIENT`.

    Returns:
      The gradient, with the sums of the metrics at their places.
    """
    return _PRIMITIVES["gradient"].bind(*arguments, spec=shape)[0]


def adam(rule: AdamRule, *arguments: Array) -> tuple[Array, ...]:
    """Make a step of Adam, whose equations are in `jetbot_mjx.agents.fused.adam`.

    Args:
      rule: what the vectors hold, and how the step size changes.
      *arguments: those of `arrays.ADAM`.

    Returns:
      The next parameters, moments and progress.
    """
    return tuple(_PRIMITIVES["adam"].bind(*arguments, spec=rule))


def update(rule: AdamRule, *arguments: Array) -> tuple[Array, ...]:
    """Make a step of Adam along the gradient of each minibatch, as `gradient` and `adam` do.

    Args:
      rule: the networks, and how the step size changes.
      *arguments: those of `arrays.UPDATE`.

    Returns:
      The parameters, moments and progress after the last minibatch.
    """
    return tuple(_PRIMITIVES["update"].bind(*arguments, spec=rule))


def _primitive(kernel: Signature) -> Primitive:
    """Return the primitive of a kernel, which the launchers lower."""
    primitive = make_primitive(f"ppo_{kernel.name}", "spec")

    def result_shapes(
        arguments: Sequence[Array | ShapedArray], spec: Spec
    ) -> list[tuple[int, ...]]:
        shapes = kernel.shapes(spec, kernel.batch_of(spec, arguments))
        return [(*kernel.replica_axes(arguments), *shapes[name]) for name in kernel.returns]

    # The shapes, for any number of replicas.
    @primitive.def_abstract_eval
    def abstract(*arguments: ShapedArray, spec: Spec) -> list[ShapedArray]:
        return [ShapedArray(shape, np.float32) for shape in result_shapes(arguments, spec)]

    def lowered(launcher: Launcher, *arguments: Array, spec: Spec) -> list[Array]:
        # One axis of replicas. XLA would copy what is changed in place if it had another shape.
        axes = len(kernel.replica_axes(arguments))
        flat = {
            name: x if name in kernel.returns else x.reshape(-1, *x.shape[axes:])
            for name, x in zip(kernel.arguments, arguments, strict=True)
        }
        results = launcher.launch(kernel, spec, kernel.batch_of(spec, arguments), flat)
        shapes = result_shapes(arguments, spec)
        return [x.reshape(shape) for x, shape in zip(results, shapes, strict=False)]

    # For every platform that has the kernel, whatever the default one is.
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
