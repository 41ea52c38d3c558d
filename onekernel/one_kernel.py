"""Compile a function of one instance as one kernel, with another kernel inside it.

Motivation: around a simulation's physics, a step of a training computes observation, reward, the
end of the episode, and the first state of the next one. XLA compiles that to forty small kernels,
in which a GPU mostly waits for the next launch, and of which a CPU compiles each for 16 ms.

Protocol: `OneKernel` traces the function. Where it calls one kernel that steps
(`Kernel.as_step`), the equations divide into those that the arguments of that kernel need and those
that the results need. Both are lowered to scalars, and run in the kernel before its first step and
after its last. Values that both need are computed twice, so that no register holds them during the
steps. A function that calls no kernel is lowered whole. A function that cannot be lowered, or calls
several kernels, is left to XLA.
"""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Literal, Var, jaxpr_as_fun
from jaxtyping import Array, PyTree

from onekernel.backends import default_backend
from onekernel.errors import KernelError, UnsupportedError
from onekernel.kernel import Kernel, called_by, warn_of_fallback
from onekernel.lower import scalarize_part

_SETTINGS = ("jax_threefry_partitionable", "jax_enable_x64", "jax_default_matmul_precision")
"""JAX's settings on which the kernel of a function depends."""


class OneKernel:
    """A `OneKernel` is a function of one instance, as one kernel if it can be.

    Otherwise it is the function itself. It cannot be differentiated where it is a kernel;
    `jax.vmap` batches it.
    """

    def __init__(
        self,
        function: Callable[..., PyTree],
        may_be_kernel: Callable[[], bool] = lambda: True,
        on_unsupported: Callable[[UnsupportedError], None] = lambda error: None,
        explain: Callable[[KernelError], Exception] = lambda error: error,
        on_fallback: Callable[[str], None] = warn_of_fallback,
    ) -> None:
        """Wrap a function.

        Args:
          function: a function of pytrees of arrays. It is traced once for all arguments of the same
            shapes.
          may_be_kernel: returns whether there may be a kernel. It is asked when the function is
            called: to try a back end takes a GPU 0.3 s, which a program from the cache saves.
          on_unsupported: is called with the reason in every call for which there is no kernel
            because the function cannot be lowered.
          explain: as for `Kernel`, for a function that calls no kernel.
          on_fallback: likewise.
        """
        functools.update_wrapper(self, function)
        self._function, self._may_be_kernel = function, may_be_kernel
        self._on_unsupported = on_unsupported
        self._explain, self._on_fallback = explain, on_fallback
        self._known: dict[tuple[Hashable, ...], _Lowered] = {}

    def __call__(self, *arguments: PyTree) -> PyTree:
        """Compute the function."""
        if not self._is_allowed():
            return self._function(*arguments)
        # A kernel takes flat arrays: it is found by the tree, shapes and dtypes of the arguments.
        leaves, structure = jax.tree.flatten(arguments)
        arrays = [x if isinstance(x, jax.Array) else jnp.asarray(x) for x in leaves]
        lowered = self._find(structure, [x.aval for x in arrays], arguments)
        if isinstance(lowered.one, UnsupportedError):
            self._on_unsupported(lowered.one)
        return jax.tree.unflatten(lowered.structure, lowered.launch(*leaves))

    def kernel_for(self, *arguments: PyTree) -> Kernel | None:
        """Return the kernel that a call launches, without compiling it.

        Args:
          arguments: the shapes and dtypes of the arguments.

        Returns:
          The kernel. Its arguments are the leaves of the function's arguments, and its results have
          the shapes of the first argument's leaves. None: a call launches no kernel, takes or
          returns other numbers than float32, or returns another structure or other shapes than its
          first argument has.
        """
        if not self._is_allowed():
            return None
        leaves, structure = jax.tree.flatten(arguments)
        avals = [ShapedArray(x.shape, x.dtype) for x in leaves]
        lowered = self._find(structure, avals, arguments)
        jaxpr = lowered.traced.jaxpr
        if lowered.places or any(x != np.float32 for x in _dtypes([*jaxpr.invars, *jaxpr.outvars])):
            return None
        # A caller repeats the kernel: its results must look like its first argument.
        carried, tree = jax.tree.flatten(arguments[0])
        results = [x.aval.shape for x in jaxpr.outvars]
        if lowered.structure != tree or results != [x.shape for x in carried]:
            return None
        return lowered.one if isinstance(lowered.one, Kernel) else None

    def _is_allowed(self) -> bool:
        # With `jax_disable_jit` the user wants to see every operation.
        return not jax.config.values["jax_disable_jit"] and self._may_be_kernel()

    def _find(
        self, structure: Hashable, avals: Sequence[ShapedArray], arguments: Sequence[PyTree]
    ) -> "_Lowered":
        """Return the function for arguments like these, traced and lowered if it is not yet."""
        # The same function lowers differently under other settings of JAX.
        settings = tuple(jax.config.values.get(name) for name in _SETTINGS)
        key = (structure, settings, *((x.shape, x.dtype, x.weak_type) for x in avals))
        if key in self._known:
            return self._known[key]
        traced, shapes = jax.make_jaxpr(self._function, return_shape=True)(*arguments)
        # A constant that is a tracer comes from a function that is being traced around this one.
        # Its value is not known now, so the kernel takes it as one more argument.
        places = [i for i, x in enumerate(traced.consts) if isinstance(x, Tracer)]
        try:
            one = _lower(traced, places)
            # A step inside has brought its own messages; a kernel without one takes those of this
            # object.
            if not one.before:
                one.explain, one.on_fallback = self._explain, self._on_fallback
        except UnsupportedError as error:
            one = error
        lowered = _Lowered(traced, jax.tree.structure(shapes), places, one)
        # A tracer is valid only while that other function is traced: do not remember such a kernel.
        if not places:
            self._known[key] = lowered
        return lowered


@dataclasses.dataclass
class _Lowered:
    """A `_Lowered` is a function for arguments of some shapes, traced and lowered."""

    traced: ClosedJaxpr
    structure: Hashable
    """Tree structure of the results, a `PyTreeDef`."""
    places: list[int]
    """Places of the constants that the kernel takes as arguments, before the others."""
    one: Kernel | UnsupportedError
    """The kernel, or why there is none."""

    @functools.cached_property
    def launch(self) -> Callable[..., list[Array]]:
        """Return the function of flat arguments, whose kernel begins to be compiled."""
        if isinstance(self.one, UnsupportedError):
            return jaxpr_as_fun(self.traced)
        # Compile the kernel in a thread, while XLA compiles the program around it.
        backend = default_backend()
        if backend and self.one.impl in ("auto", backend.IMPL) and not backend.obstacle():
            backend.prepare(self.one)
        launch = self.one.as_function()
        # Kernels take and return float32 only, so numbers of other dtypes travel as their bits.
        constants = [self.traced.consts[i] for i in self.places]
        arguments = _dtypes(_arguments(self.traced, self.places))
        results = _dtypes(self.traced.jaxpr.outvars)

        def run(*leaves: Array) -> list[Array]:
            pairs = zip((*constants, *leaves), arguments, strict=True)
            passed = [_to_pass(jnp.asarray(x, dtype)) for x, dtype in pairs]
            return _received(launch(passed), results)

        return run


def _lower(traced: ClosedJaxpr, places: Sequence[int]) -> Kernel:
    """Lower a traced function to a kernel.

    Args:
      traced: the function.
      places: the places of those of its constants that are arguments of the kernel, before others.

    Raises:
      UnsupportedError: an operation cannot be lowered, or there are several kernels in it.
    """
    # A kernel without arguments has no instances.
    arguments, results = _arguments(traced, places), traced.jaxpr.outvars
    if not arguments:
        raise UnsupportedError("a function of nothing")
    # Functions around a step test whether its state is finite, so here NaN must stay NaN.
    lower = functools.partial(scalarize_part, traced, words=True, finite=False)
    calls = [x for x in traced.jaxpr.eqns if called_by(x) is not None]
    # Without a kernel inside, the whole function becomes one that runs once.
    if not calls:
        return Kernel(
            lower(arguments, results),
            carried=0,
            steps=1,
            fallback=_fallback(traced, places),
            argument_dtypes=_passed_dtypes(arguments),
            result_dtypes=_passed_dtypes(results),
        )
    # Otherwise cut the function at the call. The one step must be plain: not a map, not itself made
    # of three parts, and called for one instance.
    step = called_by(calls[0])
    if len(calls) > 1 or step is None or step.table is not None or step.before or step.after:
        raise UnsupportedError("more than one kernel")
    if [tuple(x.aval.shape) for x in calls[0].invars] != step.argument_shapes:
        raise UnsupportedError("a kernel for several instances")
    # The part in front computes the arguments of the call; the part behind computes the results
    # from the arguments of the function and the results of the call. `scalarize_part` lowers only
    # what its results need, so the cut needs no list of equations.
    before = lower(arguments, calls[0].invars)
    after = lower([*arguments, *calls[0].outvars], results)
    return Kernel(
        step.program,
        carried=step.carried,
        steps=step.steps,
        fallback=_fallback(traced, places),
        impl=step.impl,
        explain=step.explain,
        on_fallback=step.on_fallback,
        before=before,
        after=after,
        argument_dtypes=_passed_dtypes(arguments),
        result_dtypes=_passed_dtypes(results),
    )


def _arguments(traced: ClosedJaxpr, places: Sequence[int]) -> list[Var]:
    """Return the variables of a jaxpr that are arguments of its kernel."""
    return [*(traced.jaxpr.constvars[i] for i in places), *traced.jaxpr.invars]


def _dtypes(atoms: Sequence[Var | Literal]) -> list[np.dtype]:
    return [np.dtype(cast(ShapedArray, atom.aval).dtype) for atom in atoms]


def _fallback(traced: ClosedJaxpr, places: Sequence[int]) -> Callable[..., list[Array]]:
    """Return the same computation in JAX, of what is passed to the kernel."""
    dtypes = _dtypes(_arguments(traced, places))

    def run(*passed: Array) -> list[Array]:
        arguments = _received(passed, dtypes)
        constants = list(traced.consts)
        # The first arguments are constants; `zip` stops after these.
        for place, argument in zip(places, arguments, strict=False):
            constants[place] = argument
        closed = ClosedJaxpr(traced.jaxpr, constants)
        return [_to_pass(x) for x in jaxpr_as_fun(closed)(*arguments[len(places) :])]

    return run


# A kernel takes and returns numbers of 32 bits as they are, and a bool as 0.0 or 1.0.


def _passed_dtypes(atoms: Sequence[Var | Literal]) -> list[np.dtype]:
    return [np.dtype(np.float32) if dtype.kind == "b" else dtype for dtype in _dtypes(atoms)]


def _to_pass(x: Array) -> Array:
    return x.astype(jnp.float32) if x.dtype.kind == "b" else x


def _received(passed: Sequence[Array], dtypes: Sequence[np.dtype]) -> list[Array]:
    pairs = zip(passed, dtypes, strict=True)
    return [x != 0 if dtype.kind == "b" else x for x, dtype in pairs]
