"""Run a function of one instance as one kernel for all instances.

Motivation: `jax.vmap` and XLA compile a step of a simulation to hundreds of kernels, and every
value that passes from one kernel to the next goes through memory. Lowered to scalars
(`onekernel.lower`), the same function is one kernel that reads the state of an instance, runs any
number of steps, and writes the state back.

An image is the other case: the pixels of an instance share some arguments, such as the camera's
pose, and each has others of its own, such as its ray. `Kernel.table` holds the latter, a column for
each pixel (an item). The program runs for every item of every instance. Operations on shared
arguments alone are computed once per instance (CPU) or thread (GPU), and the results are bytes.

Protocol: JAX sees the kernel as a primitive.

1. `Kernel.as_step` binds the primitive to the leaves of (carry, consts) of one instance,
   `Kernel.as_map` to those that all items of an instance share; all are float32, or what
   `Kernel.argument_dtypes` states.
2. The batching rule of `jax.vmap` puts any number of batch axes into one launch.
3. The primitive is lowered for the platform that a program is compiled for, whatever the
   process's default is, so that programs for CPUs and GPUs can exist side by side. The back end
   (`onekernel.cpu` or `onekernel.gpu`) compiles and launches the kernel. Without a back end, a
   kernel with `impl = auto` runs its fallback in JAX, and any other one raises a `KernelError`.
4. Differentiation makes other kernels (`onekernel.derivatives`), or raises a `KernelError`.
"""

import contextlib
import contextvars
import dataclasses
import functools
import math
import threading
import warnings
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import JaxprEqn, Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float, PyTree, UInt8

from onekernel.codegen import require
from onekernel.errors import KernelError, UnsupportedError
from onekernel.lower import LateProgram, ScalarProgram, bits_of, scalarize


def warn_of_fallback(reason: str) -> None:
    """Warn that something slower takes the place of a kernel."""
    warnings.warn(f"a kernel is computed by XLA, slower: {reason}", stacklevel=2)


Step = Callable[[PyTree, PyTree], PyTree]
"""A function of (carry, consts) that returns the carry some steps later."""


@dataclasses.dataclass(eq=False, repr=False)
class Kernel:
    """A `Kernel` holds a function of one instance that a back end can run for many instances.

    Without a table it is a step whose results replace its first arguments. It is repeated `steps`
    times; `before` runs once in front of the first step, and `after` once behind the last. Kernels
    are compared by identity.
    """

    program: ScalarProgram
    """The step. Its results have the shapes of its first `carried` arguments, unless it runs only
    once. With a table, its last argument is a column of the table, and its results are scalars from
    0 to 255, which are rounded down to bytes."""
    carried: int
    """Number of argument leaves that are carried from step to step."""
    steps: int
    """Number of steps."""
    fallback: Callable[..., list[Array]]
    """The same computation in JAX, as a function of all leaves of one instance, for platforms
    without a back end."""
    impl: str = "auto"
    """Name of the back end that must run the kernel; `auto` takes the back end of the platform, or
    the fallback if there is none."""
    explain: Callable[[KernelError], Exception] = lambda error: error
    """A function that returns the exception that is raised for an error, in the caller's words."""
    on_fallback: Callable[[str], None] = warn_of_fallback
    """A function that is called with the reason where the fallback runs although the platform has a
    back end."""
    inline: Callable[..., list[Array]] | None = None
    """The same computation as a function that JAX can differentiate; None: `fallback` is one."""
    derivatives: "Differentiable | None" = None
    """What differentiates the kernel; None: it cannot be differentiated."""
    on_batch: Callable[[], None] = lambda: None
    """A function that is called where `jax.vmap` batches the kernel."""
    before: ScalarProgram | None = None
    """A function from the arguments to those of the first step; None: they are the same."""
    after: ScalarProgram | None = None
    """A function from the arguments and the results of the last step to the results; None: they
    are those of the last step."""
    table: Float[np.ndarray, "rows items"] | None = None
    """The arguments that differ between the items of an instance; None: the kernel is a step."""
    argument_dtypes: Sequence[np.dtype] | None = None
    """Dtypes of the arguments, whose bits the program takes as float32: of a number of 64 bits, two
    along a last axis. XLA passes the arrays as they are: for a CPU it would compile every
    conversion to a kernel of its own. None: all are float32."""
    result_dtypes: Sequence[np.dtype] | None = None
    """Those of the results, likewise; with a table there are none."""
    identity: str | None = None
    """What the kernel is made from, by which it is known in other processes; None: its programs."""
    _texts: dict[str, str] = dataclasses.field(default_factory=dict, init=False)
    """Texts that back ends have written of the kernel, by a name of their choice."""
    # Programs are lowered in several threads, and each text is written once.
    _lock: contextlib.AbstractContextManager[bool] = dataclasses.field(
        default_factory=threading.Lock, init=False
    )

    def __post_init__(self) -> None:
        """Check that the programs can be written as LLVM IR.

        Raises:
          UnsupportedError: one of them has an operation that has no LLVM instruction.
        """
        for program in self.programs:
            if not isinstance(program, LateProgram):
                require(program)

    @functools.cached_property
    def unsupported(self) -> UnsupportedError | None:
        """Lower a late program, and return why the kernel cannot be one; None: it can."""
        try:
            if isinstance(self.program, LateProgram):
                self.program = self.program.lowered
                require(self.program)
        except UnsupportedError as error:
            return error
        return None

    def as_step(self) -> Step:
        """Return the kernel as a JAX function of one instance, which `jax.vmap` can batch.

        Returns:
          A function of (carry, consts) that returns the new carry. The leaves of both pytrees are
          the kernel's arguments and must be float32. It can be differentiated if the kernel has
          `derivatives`.
        """

        def step(carry: PyTree, consts: PyTree) -> PyTree:
            leaves = jax.tree.leaves((carry, consts))
            if _is_inlined.get():
                results = (self.inline or self.fallback)(*leaves)
            else:
                # While JAX traces, `bind` records one equation; `_lowered` below says what it
                # compiles to.
                results = _kernel_p.bind(*leaves, kernel=self)
            return jax.tree.unflatten(jax.tree.structure(carry), results)

        return step

    def as_function(self) -> Callable[[Sequence[Array]], list[Array]]:
        """Return a kernel without a table as a JAX function of one instance; `jax.vmap` batches it.

        Returns:
          A function from the kernel's arguments to its results. It can be differentiated if the
          kernel has `derivatives`.
        """
        return lambda leaves: _kernel_p.bind(*leaves, kernel=self)

    def as_map(self) -> Callable[[PyTree], UInt8[Array, " bytes"]]:
        """Return a kernel with a table as a JAX function of one instance; `jax.vmap` batches it.

        Returns:
          A function of a pytree, whose leaves are the kernel's arguments and must be float32. It
          returns the bytes of all items, one after the other. It cannot be differentiated.
        """
        return lambda shared: _kernel_p.bind(*jax.tree.leaves(shared), kernel=self)[0]

    def text(self, name: str, write: Callable[[], str]) -> str:
        """Return the text that is cached under a name; call `write` for it on first use."""
        with self._lock:
            if name not in self._texts:
                self._texts[name] = write()
            return self._texts[name]

    @property
    def argument_shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of the arguments of one instance."""
        return _without_words(self._taken, self.argument_dtypes)

    @property
    def argument_words(self) -> list[int]:
        """Return how many words of 32 bits each argument of one instance has."""
        return list(map(math.prod, self._taken))

    @property
    def result_words(self) -> list[int]:
        """Return how many words of 32 bits each result of one instance has, without a table."""
        return list(map(math.prod, (self.after or self.program).output_shapes))

    @property
    def programs(self) -> list[ScalarProgram]:
        """Return what runs before the first step, the step, and what runs after the last one."""
        return [x for x in (self.before, self.program, self.after) if x is not None]

    @property
    def array_bytes(self) -> int:
        """Return the bytes of memory that the arrays of one instance, or item, take."""
        return max(program.array_bytes for program in self.programs)

    @property
    def _taken(self) -> list[tuple[int, ...]]:
        """Return the shapes of the arguments as the first program takes them."""
        shapes = (self.before or self.program).input_shapes
        return shapes if self.table is None else shapes[:-1]

    def results(self, *batch: int) -> list[jax.ShapeDtypeStruct]:
        """Return the shapes, behind the given batch axes, and dtypes of the results."""
        if self.table is not None:
            size = self.table.shape[1] * len(self.program.outputs)
            return [jax.ShapeDtypeStruct((*batch, size), np.uint8)]
        shapes = _without_words((self.after or self.program).output_shapes, self.result_dtypes)
        dtypes = self.result_dtypes or [np.dtype(np.float32)] * len(shapes)
        return [
            jax.ShapeDtypeStruct((*batch, *shape), dtype)
            for shape, dtype in zip(shapes, dtypes, strict=True)
        ]


def _without_words(
    shapes: list[tuple[int, ...]], dtypes: Sequence[np.dtype] | None
) -> list[tuple[int, ...]]:
    """Return the shapes of arrays of some dtypes, from those in which programs take them."""
    if dtypes is None:
        return shapes
    pairs = zip(shapes, dtypes, strict=True)
    return [shape[:-1] if bits_of(dtype) == 64 else shape for shape, dtype in pairs]


class Compiled(NamedTuple):
    """A `Compiled` tells what the compiler made of a kernel, in words for the user."""

    target: str
    """The processor."""
    seconds: float
    """How long it took [s]."""
    registers: str
    """The registers that it uses."""
    spilled: str
    """What did not fit into them."""


class Differentiable(Protocol):
    """A `Differentiable` differentiates a kernel by JAX's rules for a primitive."""

    def jvp(
        self, primals: Sequence[Array], tangents: Sequence[Array | ad.Zero]
    ) -> tuple[list[Array], list[Array | ad.Zero]]:
        """Return results and their tangents."""
        ...

    def transpose(
        self, cotangents: Sequence[Array | ad.Zero], arguments: Sequence[Array | ad.UndefinedPrimal]
    ) -> list[Array | ad.Zero | None]:
        """Return the cotangents of the arguments that are not known."""
        ...


class Backend(Protocol):
    """A `Backend` compiles and launches kernels for one platform."""

    IMPL: str
    """The back end's name in `Kernel.impl`."""
    PLATFORM: str
    """The JAX platform that the back end serves."""

    def obstacle(self) -> str | None:
        """Return why kernels cannot run in this process, with the remedy, or None if they can."""
        ...

    def refusal(self, kernel: Kernel) -> str | None:
        """Return why this kernel cannot run although others can, or None if it can."""
        ...

    def prepare(self, kernel: Kernel) -> None:
        """Begin to compile a kernel in a thread, before a program is lowered that launches it."""
        ...

    def inspect(self, kernel: Kernel) -> Compiled:
        """Compile a kernel, whatever the caches hold, and return what the compiler made of it."""
        ...

    def launch(self, kernel: Kernel, leaves: Sequence[Array]) -> list[Array]:
        """Run a kernel; JAX calls this while it lowers a program for the platform.

        Args:
          kernel: the kernel.
          leaves: its arguments, arrays of shape (instances, ...), and its table if it has one.

        Returns:
          The results, as in `Kernel.results(instances)`.
        """
        ...


def is_debugging() -> bool:
    """Return whether JAX looks for the operation that computes NaN or infinity: a kernel is one."""
    return jax.config.values["jax_debug_nans"] or jax.config.values["jax_debug_infs"]


def called_by(equation: JaxprEqn) -> Kernel | None:
    """Return the kernel that an equation of a jaxpr calls; None: it does something else."""
    return equation.params["kernel"] if equation.primitive is _kernel_p else None


def make_primitive(
    name: str, static: str, on_batch: Callable[..., None] = lambda parameter: None
) -> Primitive:
    """Return a primitive of one instance, which `jax.vmap` batches by an axis in front of all.

    Its arguments and results are arrays. The caller defines the shapes of its results
    (`def_abstract_eval`) and its lowering for each platform (`mlir.register_lowering`).

    Args:
      name: its name.
      static: the name of its parameter, which is not an array.
      on_batch: is called with that parameter where `jax.vmap` batches the primitive.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True
    # Outside of a jitted function, JAX runs a primitive by compiling a program of this one
    # operation.
    compiled = jax.jit(primitive.bind, static_argnames=static)

    @primitive.def_impl
    def run(*arrays: Array, **parameters: object) -> list[Array]:
        # Enable jit here: within `jax.disable_jit` this function would call itself, and so it would
        # where JAX runs it again to find the operation that computed NaN or infinity.
        with jax.disable_jit(False), jax.debug_nans(False), jax.debug_infs(False):
            return compiled(*arrays, **parameters)

    def batch(
        arrays: Sequence[Array], axes: Sequence[int | None], **parameters: object
    ) -> tuple[list[Array], list[int]]:
        on_batch(parameters[static])
        # All arguments that have the batch axis agree on its size. Move it to the front of these,
        # and repeat the others along it.
        (size,) = {x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None}
        moved = [
            jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(arrays, axes, strict=True)
        ]
        # Bind the same primitive again, which takes any number of leading axes: `vmap` can be
        # nested.
        results = primitive.bind(*moved, **parameters)
        return results, [0] * len(results)

    batching.primitive_batchers[primitive] = batch
    return primitive


_kernel_p = make_primitive("onekernel", "kernel", on_batch=lambda kernel: kernel.on_batch())


_is_inlined = contextvars.ContextVar("_is_inlined", default=False)


@contextlib.contextmanager
def inlined() -> Iterator[None]:
    """In this context, trace what a step computes (`Kernel.inline`) in place of a kernel."""
    token = _is_inlined.set(True)
    try:
        yield
    finally:
        _is_inlined.reset(token)


def _batch_shape(kernel: Kernel, leaves: Sequence[Array | ShapedArray]) -> tuple[int, ...]:
    """Return the batch axes that all arguments have in front of the axes of one instance.

    Raises:
      KernelError: an argument does not have the dtype that the kernel expects, mostly float32.
      ValueError: an argument does not have the shape that the kernel expects.
    """
    shapes = kernel.argument_shapes
    # The first argument tells the batch axes, and all others must have the same.
    batch = leaves[0].shape[: leaves[0].ndim - len(shapes[0])]
    dtypes = kernel.argument_dtypes or [np.dtype(np.float32)] * len(shapes)
    for leaf, shape, dtype in zip(leaves, shapes, dtypes, strict=True):
        if leaf.dtype != dtype:
            error = KernelError(f"one kernel takes {dtype} only, not {leaf.dtype}", "dtype")
            raise kernel.explain(error)
        if leaf.shape != (*batch, *shape):
            raise ValueError(f"an argument of shape {leaf.shape}, not {(*batch, *shape)}")
    return batch


@_kernel_p.def_abstract_eval
def _abstract(*leaves: ShapedArray, kernel: Kernel) -> list[ShapedArray]:
    shapes = [(x.shape, x.dtype) for x in kernel.results(*_batch_shape(kernel, leaves))]
    # Inside of `jax.shard_map`, results vary along the axes of the mesh along which arguments do.
    axes = frozenset().union(*map(varying_axes, leaves))
    if not axes:
        return [ShapedArray(shape, dtype) for shape, dtype in shapes]
    kind = jax.sharding.ManualAxisType(varying=axes)
    mesh = next(x.sharding.mesh for x in leaves if varying_axes(x))
    return [
        ShapedArray(
            shape,
            dtype,
            sharding=jax.NamedSharding(mesh, jax.P(*[None] * len(shape))),
            manual_axis_type=kind,
        )
        for shape, dtype in shapes
    ]


def varying_axes(x: ShapedArray) -> frozenset[Hashable]:
    """Return the axes of a mesh along which an array varies; none outside of `jax.shard_map`."""
    kind = getattr(x, "mat", None)
    return frozenset() if kind is None else kind.varying


def varying_alike(arrays: Sequence[Array]) -> list[Array]:
    """Return arrays that vary along the same axes of a mesh, inside of `jax.shard_map`."""
    axes = frozenset().union(*(varying_axes(jax.typeof(x)) for x in arrays))

    def spread(x: Array) -> Array:
        lacking = tuple(axes - varying_axes(jax.typeof(x)))
        return jax.lax.pcast(x, lacking, to="varying") if lacking else x

    return list(map(spread, arrays))


def _differentiate(
    primals: Sequence[Array], tangents: Sequence[Array | ad.Zero], *, kernel: Kernel
) -> tuple[list[Array], list[Array | ad.Zero]]:
    return _derivatives(kernel).jvp(primals, tangents)


def _transpose(
    cotangents: Sequence[Array | ad.Zero],
    *arguments: Array | ad.UndefinedPrimal,
    kernel: Kernel,
) -> list[Array | ad.Zero | None]:
    return _derivatives(kernel).transpose(cotangents, arguments)


def _derivatives(kernel: Kernel) -> Differentiable:
    """Return what differentiates a kernel.

    Raises:
      KernelError: it cannot be differentiated.
    """
    if kernel.derivatives is None:
        raise kernel.explain(KernelError("one kernel cannot be differentiated", "derivative"))
    return kernel.derivatives


ad.primitive_jvps[_kernel_p] = _differentiate
ad.primitive_transposes[_kernel_p] = _transpose


def probe(
    launch: Callable[[Kernel, Sequence[Array]], list[Array]], device: object, instances: int
) -> str | None:
    """Run a small kernel, and return why it failed, or None if its result is correct.

    Args:
      launch: the back end's function.
      device: the `jax.Device` to run on.
      instances: the number of instances.
    """
    kernel = Kernel(
        scalarize(lambda x: 2.0 * x + 1.0, jax.ShapeDtypeStruct((2,), jnp.float32)),
        carried=1,
        steps=2,
        fallback=lambda x: [4.0 * x + 3.0],
    )
    # Two steps of 2x + 1 are 4x + 3.
    values = np.arange(2 * instances, dtype=np.float32).reshape(-1, 2)
    # Run the probe at once, because the caller may be tracing another function.
    with jax.ensure_compile_time_eval(), jax.default_device(device):
        try:
            # An array of JAX would be another program to compile.
            (result,) = jax.jit(lambda x: launch(kernel, [x]))(values)
        except jax.errors.JaxRuntimeError as error:
            return f"a small kernel failed: {str(error).partition(chr(10))[0]}"
        correct = (np.asarray(result) == 4 * values + 3).all()
        return None if correct else "a small kernel returned wrong numbers"


def _obstacle(backend: Backend | None, kernel: Kernel) -> str | None:
    """Return why a back end cannot run a kernel, or None if it can."""
    if kernel.impl not in ("auto", backend and backend.IMPL):
        return f"this program is for {backend.PLATFORM if backend else 'another platform'}"
    if backend is None:
        return "there are no kernels for this platform"
    if obstacle := backend.obstacle():
        return obstacle
    reason = kernel.unsupported or backend.refusal(kernel)
    return f"one kernel cannot do {reason}" if reason else None


def _lowered(backend: Backend | None) -> Callable[..., list[Array]]:
    """Return the function that JAX lowers for a back end's platform; None: all other platforms."""

    def lowered(*leaves: Array, kernel: Kernel) -> list[Array]:
        batch = _batch_shape(kernel, leaves)
        instances = math.prod(batch)
        # Back ends know one axis of instances: merge all batch axes into it, and split them at the
        # end.
        flat = [
            x.reshape(instances, *shape)
            for x, shape in zip(leaves, kernel.argument_shapes, strict=True)
        ]
        # Run the kernel where its back end is allowed and works, the fallback where `auto` permits.
        obstacle = _obstacle(backend, kernel)
        if backend and not obstacle:
            table = [] if kernel.table is None else [jnp.asarray(kernel.table)]
            results = backend.launch(kernel, [*flat, *table])
        elif obstacle and kernel.impl == "auto":
            # The fallback is written for one instance. It may raise an error of JAX's.
            results = jax.vmap(lambda *leaves: kernel.fallback(*leaves))(*flat)
            kernel.on_fallback(obstacle)
        else:
            raise kernel.explain(KernelError(str(obstacle), "platform"))
        wanted = kernel.results(*batch)
        return [x.reshape(like.shape) for x, like in zip(results, wanted, strict=True)]

    return lowered


def register(*backends: Backend) -> None:
    """Make back ends known to JAX."""
    # The first call sets the rule for all platforms; those with a back end get their own below.
    mlir.register_lowering(_kernel_p, mlir.lower_fun(_lowered(None), multiple_results=True))
    for backend in backends:
        mlir.register_lowering(
            _kernel_p,
            mlir.lower_fun(_lowered(backend), multiple_results=True),
            platform=backend.PLATFORM,
        )
