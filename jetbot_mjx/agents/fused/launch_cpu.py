"""Launch the kernels of PPO on CPUs, of which one computes a whole update."""

import functools
import itertools
from collections.abc import Callable, Collection, Mapping, Sequence

import jax
import numpy as np
from jaxtyping import Array

from jetbot_mjx.agents.fused.arrays import UPDATE, Arrays, Signature, Spec
from jetbot_mjx.agents.fused.cpu_actions import ActionStage, UnrollStage
from jetbot_mjx.agents.fused.cpu_adam import adam_stages, update_stages
from jetbot_mjx.agents.fused.cpu_gradient import gradient_stages
from jetbot_mjx.agents.fused.cpu_network import HEAD
from jetbot_mjx.agents.fused.cpu_stages import Call, Stage
from jetbot_mjx.agents.fused.shapes import DataSizes, UnrollSpec, UpdateShape
from onekernel.build import Backend, cpu, in_background

BACKEND: Backend = cpu
"""The back end that compiles the kernels."""

_WIDTH_STEP = 16
_MOST_MEMORY = 4 << 20
"""Bytes of scratch memory of a part; what it works with should stay in the processor's cache."""


def refusal(shape: UpdateShape, batch: DataSizes) -> str | None:
    """Return why the CPUs of this process cannot run the kernels, or None.

    Args:
      shape: the networks.
      batch: the minibatch.
    """
    # Whether there is a compiler at all, and then the sizes that the stages can take.
    return cpu.obstacle() or misfit(shape, batch, cpu.host_processor().lanes)


def misfit(shape: UpdateShape, batch: DataSizes, lanes: int) -> str | None:
    """Return which size the kernels cannot take, or None.

    Args:
      shape: the networks.
      batch: the minibatch.
      lanes: the number of float32 values in a vector register.
    """
    outputs = max(shape.outputs)
    if outputs > HEAD:
        return f"it takes at most {HEAD} outputs, not {outputs}"
    if shape.width % _WIDTH_STEP:
        return f"it takes layers of 16, 32, 48, ... units, not {shape.width}"
    if max(4 * x.scratch for x, *_ in gradient_stages(shape, batch, lanes)) > _MOST_MEMORY:
        return f"unrolls of {batch.time} steps do not fit in {_MOST_MEMORY >> 20} MiB"
    return None


_STAGES: Mapping[str, Callable[..., Sequence[Sequence[Stage]]]] = {
    "actions": lambda *arguments: [[ActionStage(*arguments)]],
    "unroll": lambda *arguments: [[UnrollStage(*arguments)]],
    "gradient": gradient_stages,
    "adam": adam_stages,
    "update": update_stages,
}
"""Functions that return the stages of a kernel, by its name, from what it is written for, the sizes
of the data, and the number of float32 values in a vector register."""

NAMES: Collection[str] = frozenset(_STAGES)
"""Names of the kernels, as in `launch.Launcher`."""


def call_of(kernel: Signature, spec: Spec, batch: DataSizes, lanes: int) -> Call:
    """Return the call of a kernel.

    Args:
      kernel: the kernel.
      spec: what it is written for.
      batch: the data, from `Signature.relevant`.
      lanes: the number of float32 values in a vector register.
    """
    stages = _STAGES[kernel.name](spec, batch, lanes)
    sizes = kernel.counts(spec, batch)
    # Behind the results come the arrays between the stages, for which XLA finds memory.
    between = {name: n for x in itertools.chain(*stages) for name, n in x.handed_on.items()}
    others = [name for name in between if name not in sizes]
    return Call(
        (*kernel.arguments, *kernel.returns, *others),
        sizes | between,
        stages,
        minibatches=batch.minibatches if kernel is UPDATE else 1,
    )


def _written(host: cpu.Host, kernel: Signature, spec: Spec, batch: DataSizes) -> str:
    """Write the LLVM module of a kernel."""
    return call_of(kernel, spec, batch, host.lanes).text(host)


_written_once = functools.cache(_written)


def _text(host: cpu.Host, kernel: Signature, spec: Spec, batch: DataSizes) -> str:
    """Return the LLVM module of a kernel, which is written once."""
    if not isinstance(spec, UnrollSpec):
        return _written_once(host, kernel, spec, batch)
    # The text of an unroll is stored with the kernel of its environment, under a name that tells
    # what else the text depends on.
    name = repr((spec.shape, spec.observation, spec.kept, batch, host))
    return spec.kernel.text(name, lambda: _written(host, kernel, spec, batch))


def prepare(kernel: Signature, spec: Spec, batch: DataSizes, replicas: int) -> None:
    """Begin to compile a kernel, which serves any number of replicas, as `launch.prepare`."""
    del replicas
    host = cpu.host_processor()
    in_background(lambda: cpu.registered(_text(host, kernel, spec, batch)))


def launch(kernel: Signature, spec: Spec, batch: DataSizes, arrays: Arrays) -> list[Array]:
    """Call a kernel while JAX lowers a program for CPUs, as `launch.Launcher` specifies."""
    host, replicas = cpu.host_processor(), len(next(iter(arrays.values())))
    # Results are as long as the call says, but for those that take the place of arguments.
    call = call_of(kernel, spec, batch, host.lanes)
    names = call.arrays[len(arrays) :]
    shapes = [arrays[x].shape if x in arrays else (replicas, call.sizes[x]) for x in names]
    like = [jax.ShapeDtypeStruct(shape, np.float32) for shape in shapes]
    text = _text(host, kernel, spec, batch)
    return cpu.launch_text(text, list(arrays.values()), like, kernel.aliases)
