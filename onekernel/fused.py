"""Compile a function of one instance as one kernel, with another kernel inside it.

Motivation: around a simulation's physics, a step of a training computes observation, reward, the
end of the episode, and the first state of the next one. XLA compiles that to forty small kernels,
in which a GPU mostly waits for the next launch, and of which a CPU compiles each for 16 ms.

Protocol:

1. `Fused` traces the function for the shapes that it is called with. Random keys travel as their
   words, Python's numbers as arrays.
2. Where the function calls one kernel that steps (`Kernel.as_step`), the equations divide into
   those that the arguments of that kernel need and those that the results need. Both are lowered to
   scalars, and run in the kernel before its first step and after its last. Values that both need
   are computed twice, so that no register holds them during the steps. A function that calls no
   kernel is lowered whole. A fused function that is called inside is traced as the function that it
   is made of.
3. A function that cannot be lowered, or calls several kernels, is left to XLA, and `on_unsupported`
   says what is told.
4. The derivatives of a kernel without another inside are kernels, too (`onekernel.derivatives`).
5. With `ONEKERNEL_CHECK=1` in the environment, each new kernel is compared with XLA on random
   numbers before its first use (`onekernel.check`).
"""

import contextvars
import dataclasses
import functools
import os
import warnings
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import Literal as Choice
from typing import overload

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jaxtyping import Array, PyTree

from onekernel.backends import default_backend
from onekernel.check import check
from onekernel.derivatives import Derivatives
from onekernel.errors import KernelError, UnsupportedError
from onekernel.kernel import Kernel, inlined, is_debugging, varying_alike, varying_axes
from onekernel.keys import with_key, without_key, words_of
from onekernel.traced import (
    arguments_of,
    as_passed,
    dtypes_of,
    kernel_of,
    kernels_in,
    passed_avals,
    received,
    to_pass,
    whole_kernel_of,
)

_DERIVATIVE = "the derivative of "

CHECK = "ONEKERNEL_CHECK"
"""Environment variable: with `1`, kernels are checked before their first use."""

_SETTINGS = ("jax_threefry_partitionable", "jax_enable_x64", "jax_default_matmul_precision")
"""JAX's settings on which the kernel of a function depends."""

_is_inside: contextvars.ContextVar[bool] = contextvars.ContextVar("is_inside", default=False)
"""Whether a fused function is being traced: those that it calls become parts of it."""

OnUnsupported = Choice["warn", "xla", "raise"] | Callable[[UnsupportedError], None]
"""What happens where there is no kernel: a warning once for each reason, nothing, an
`UnsupportedError`, or a call of the function with that error. Unless it raises, XLA computes."""


@overload
def fuse(
    function: Callable[..., PyTree],
    *,
    on_unsupported: OnUnsupported = "warn",
    may_be_kernel: Callable[[], bool] = ...,
    explain: Callable[[KernelError], Exception] = ...,
    on_fallback: Callable[[str], None] | None = None,
) -> "Fused": ...


@overload
def fuse(
    function: None = None, *, on_unsupported: OnUnsupported = "warn"
) -> Callable[[Callable[..., PyTree]], "Fused"]: ...


def fuse(
    function: Callable[..., PyTree] | None = None,
    *,
    on_unsupported: OnUnsupported = "warn",
    may_be_kernel: Callable[[], bool] = lambda: True,
    explain: Callable[[KernelError], Exception] = lambda error: error,
    on_fallback: Callable[[str], None] | None = None,
) -> "Fused | Callable[[Callable[..., PyTree]], Fused]":
    """Return a function of one instance as one kernel, which `jax.vmap` runs for many instances.

    It is a function like any other to `jax.jit`, `jax.vmap`, `jax.lax.scan` and `jax.shard_map`.
    Results differ from XLA's by round-off. Its derivatives are kernels, too: one forward, which
    also returns what the other needs, and one backward. Also usable as a decorator, with or without
    arguments.

    Args:
      function: a pure JAX function of one instance. Its arguments and results are pytrees of
        float32, int32, uint32, bool and random keys, and with `jax_enable_x64` of float64, int64
        and uint64. It is traced once for all arguments of the same shapes and dtypes.
      on_unsupported: what to do if the function cannot be one kernel: "warn" says once why, and
        XLA computes it; "xla" is silent; "raise" raises the error; a function is called with it.
      may_be_kernel: returns whether there may be a kernel. It is asked when the function is called:
        to try a back end takes a GPU 0.3 s, which a program from the cache saves.
      explain: returns the exception to raise for a `KernelError`, in the caller's words.
      on_fallback: is called with the reason where a platform cannot run kernels; None: as
        `on_unsupported` says.

    Raises:
      TypeError: `function` is no function.
      ValueError: `on_unsupported` is none of these.
    """
    if not (function is None or callable(function)):
        raise TypeError(f"fuse takes a function, not {function!r}")
    if not callable(on_unsupported) and on_unsupported not in ("warn", "xla", "raise"):
        choices = "'warn', 'xla', 'raise' or a function"
        raise ValueError(f"on_unsupported = {on_unsupported!r}: choose {choices}")
    wrap = functools.partial(
        Fused,
        on_unsupported=on_unsupported,
        may_be_kernel=may_be_kernel,
        explain=explain,
        on_fallback=on_fallback,
    )
    return wrap if function is None else wrap(function)


class Fused:
    """A `Fused` is a function of one instance, as one kernel if it can be; `fuse` makes it."""

    def __init__(
        self,
        function: Callable[..., PyTree],
        on_unsupported: OnUnsupported,
        may_be_kernel: Callable[[], bool],
        explain: Callable[[KernelError], Exception],
        on_fallback: Callable[[str], None] | None,
    ) -> None:
        """Wrap a function; the arguments are those of `fuse`."""
        functools.update_wrapper(self, function)
        self._function, self._may_be_kernel = function, may_be_kernel
        self._on_unsupported, self._explain = on_unsupported, explain
        self._on_fallback = on_fallback or self._no_back_end
        self._known: dict[tuple[Hashable, ...], _Lowered] = {}
        self._told: set[str] = set()

    def __call__(self, *arguments: PyTree, **keywords: PyTree) -> PyTree:
        """Compute the function.

        Raises:
          UnsupportedError: there is no kernel, and `on_unsupported` is "raise".
          TypeError: an argument is neither an array nor a number.
        """
        if _is_inside.get() or not self._is_allowed():
            return self._function(*arguments, **keywords)
        # A kernel takes flat arrays: it is found by the tree, shapes and dtypes of the arguments.
        leaves, structure = jax.tree.flatten((arguments, keywords))
        # What depends on no instance is the same for all devices, and its derivative their sum.
        arrays = varying_alike(list(map(_as_array, leaves)))
        avals = [x.aval for x in arrays]
        lowered = self._find(structure, avals)
        if isinstance(lowered.one, UnsupportedError):
            self._report(lowered.one)
            return self._function(*arguments, **keywords)
        if os.environ.get(CHECK) == "1":
            # Inside of `jax.shard_map`, an array varies along axes of the mesh. A check runs
            # outside, where there are none.
            self._find(structure, [ShapedArray(x.shape, x.dtype) for x in avals]).check()
        results = lowered.launch(*map(without_key, arrays))
        return jax.tree.unflatten(lowered.structure, map(with_key, lowered.results, results))

    def __get__(self, instance: object, owner: type | None = None) -> "Callable[..., PyTree]":
        """Return the method of an object, if the function is decorated in a class."""
        return self if instance is None else functools.partial(self, instance)

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
        lowered = self.lowered(*arguments)
        jaxpr = lowered.traced.jaxpr
        if lowered.places or any(
            x != np.float32 for x in dtypes_of([*jaxpr.invars, *jaxpr.outvars])
        ):
            return None
        # A caller repeats the kernel: its results must look like its first argument.
        carried, tree = jax.tree.flatten(arguments[0])
        results = [x.aval.shape for x in jaxpr.outvars]
        if lowered.structure != tree or results != [x.shape for x in carried]:
            return None
        return lowered.one if isinstance(lowered.one, Kernel) else None

    def lowered(self, *arguments: PyTree, **keywords: PyTree) -> "_Lowered":
        """Return the function for arguments like these, traced and lowered if it is not yet.

        Args:
          arguments: arrays, or shapes and dtypes.
          keywords: likewise.
        """
        leaves, structure = jax.tree.flatten((arguments, keywords))
        return self._find(structure, [_shape(x) for x in leaves])

    def _is_allowed(self) -> bool:
        # With these settings the user wants to see every operation.
        is_watched = jax.config.values["jax_disable_jit"] or is_debugging()
        return not is_watched and self._may_be_kernel()

    def _report(self, error: UnsupportedError, what: str = "") -> None:
        """Do what the user wants where there is no kernel."""
        if callable(self._on_unsupported):
            self._on_unsupported(error)
        elif self._on_unsupported == "raise":
            raise error
        else:
            self._tell(f"one kernel cannot do {error}", what)

    def _no_back_end(self, reason: str) -> None:
        if self._on_unsupported == "raise":
            raise KernelError(reason, "platform")
        self._tell(reason)

    def _tell(self, reason: str, what: str = "") -> None:
        """Warn once that XLA computes the function, unless the user wants no warning.

        Args:
          reason: why.
          what: what of the function, in words before its name.
        """
        if self._on_unsupported != "xla" and what + reason not in self._told:
            self._told.add(what + reason)
            name = getattr(self, "__name__", "a function")
            warnings.warn(f"XLA computes {what}{name}, slower: {reason}", stacklevel=4)

    def _find(self, structure: Hashable, avals: Sequence[ShapedArray]) -> "_Lowered":
        # The same function lowers differently under other settings of JAX.
        settings = tuple(jax.config.values.get(name) for name in _SETTINGS)
        # Inside of `jax.shard_map`, JAX traces another jaxpr for arrays that vary along its axes.
        described = [(x.shape, x.dtype, x.weak_type, varying_axes(x)) for x in avals]
        key = (structure, settings, *described)
        if key in self._known:
            return self._known[key]
        lowered = self._trace_and_lower(structure, avals)
        # A tracer is valid only while that other function is traced: do not remember such a kernel.
        if not lowered.places:
            self._known[key] = lowered
        return lowered

    def _trace_and_lower(self, structure: Hashable, avals: Sequence[ShapedArray]) -> "_Lowered":
        def flat(*words: Array) -> PyTree:
            # Random keys are arguments as the words that they consist of.
            arguments, keywords = jax.tree.unflatten(structure, map(with_key, avals, words))
            # A result may be a number of Python, such as a reward that is always 1.
            results = self._function(*arguments, **keywords)
            return jax.tree.map(lambda x: _as_array(x, "leave other results out"), results)

        def without_keys(*words: Array) -> PyTree:
            results = flat(*words)
            kinds.append(jax.tree.map(jax.typeof, results))
            return jax.tree.map(without_key, results)

        kinds: list[PyTree] = []
        traced = _trace_inside(without_keys, map(words_of, avals))
        results, tree = jax.tree.flatten(kinds[-1])
        # A constant that is a tracer comes from a function that is being traced around this one.
        # Its value is not known now, so the kernel takes it as one more argument.
        places = [i for i, x in enumerate(traced.consts) if isinstance(x, Tracer)]
        try:
            one = kernel_of(traced, places)
            # A step inside has brought its own messages; a kernel without one takes those of this
            # object.
            if not one.before:
                one.explain, one.on_fallback = self._explain, self._on_fallback
                self._differentiate(one, one.fallback, traced, places)
            elif not places and all(x.derivatives is not None for x in kernels_in(traced)):
                self._differentiate(one, as_passed(without_keys, traced), traced, places)
        except UnsupportedError as error:
            one = error
        return _Lowered(traced, tree, results, places, one)

    def _differentiate(
        self,
        kernel: Kernel,
        function: Callable[..., list[Array]],
        traced: ClosedJaxpr,
        places: Sequence[int],
    ) -> None:
        """Give a kernel its derivatives.

        Args:
          kernel: the kernel.
          function: what it computes, of what is passed to it.
          traced: the function as it was traced.
          places: the places of those of its constants that are arguments of the kernel.
        """

        def report(error: UnsupportedError) -> None:
            self._report(error, _DERIVATIVE)

        def tell(reason: str) -> None:
            self._tell(reason, _DERIVATIVE)

        kernel.derivatives = derivatives_of(
            function,
            passed_avals(arguments_of(traced, places)),
            passed_avals(traced.jaxpr.outvars),
            explain=self._explain,
            report=report,
            on_fallback=tell if self._on_fallback == self._no_back_end else self._on_fallback,
        )


def derivatives_of(
    function: Callable[..., list[Array]],
    arguments: Sequence[ShapedArray],
    results: Sequence[ShapedArray],
    *,
    explain: Callable[[KernelError], Exception],
    report: Callable[[UnsupportedError], None],
    on_fallback: Callable[[str], None],
) -> Derivatives:
    """Return what differentiates a kernel, by kernels that are traced when they are needed.

    Args:
      function: what the kernel computes, which JAX can differentiate; of flat arrays.
      arguments: those of one instance.
      results: likewise.
      explain: returns the exception to raise for a `KernelError`, in the caller's words.
      report: is called with the reason where a derivative cannot be one kernel.
      on_fallback: is called with the reason where a platform cannot run kernels.
    """

    def make(traced: ClosedJaxpr) -> Kernel:
        one = whole_kernel_of(traced, (), is_late=True)
        one.explain, one.on_fallback = explain, on_fallback
        avals = passed_avals(traced.jaxpr.invars), passed_avals(traced.jaxpr.outvars)
        messages = {"explain": explain, "report": report, "on_fallback": on_fallback}
        one.derivatives = derivatives_of(one.fallback, *avals, **messages)
        dtypes[one] = dtypes_of(traced.jaxpr.invars), dtypes_of(traced.jaxpr.outvars)
        return one

    def is_ready(one: Kernel) -> bool:
        if one.unsupported:
            report(one.unsupported)
        elif os.environ.get(CHECK) == "1" and not any(map(varying_axes, arguments)):
            check(one, *dtypes[one])
        return one.unsupported is None

    def trace(function: Callable[..., PyTree], avals: Iterable[ShapedArray]) -> ClosedJaxpr:
        with inlined():
            return _trace_inside(function, avals)

    dtypes: dict[Kernel, tuple[list[np.dtype], list[np.dtype]]] = {}
    return Derivatives(
        function,
        arguments,
        results,
        trace=trace,
        make=make,
        is_ready=functools.cache(is_ready),
    )


def _trace_inside(function: Callable[..., PyTree], avals: Iterable[ShapedArray]) -> ClosedJaxpr:
    """Trace a function, and the fused ones that it calls as the functions that they are made of."""
    token = _is_inside.set(True)
    try:
        return _without_key_constants(jax.make_jaxpr(function)(*avals))
    finally:
        _is_inside.reset(token)


@dataclasses.dataclass
class _Lowered:
    """A `_Lowered` is a function for arguments of some shapes, traced and lowered."""

    traced: ClosedJaxpr
    structure: Hashable
    """Tree structure of the results, a `PyTreeDef`."""
    results: list[ShapedArray]
    """Shapes and dtypes of the results, with random keys."""
    places: list[int]
    """Places of the constants that the kernel takes as arguments, before the others."""
    one: Kernel | UnsupportedError
    """The kernel, or why there is none."""
    _is_checked: bool = dataclasses.field(default=False, init=False)

    @functools.cached_property
    def launch(self) -> Callable[..., list[Array]]:
        """Return the kernel as a function of flat arguments."""
        assert isinstance(self.one, Kernel)
        self.one.on_batch = functools.cache(self._prepare)
        launch = self.one.as_function()
        constants = [self.traced.consts[i] for i in self.places]
        arguments = dtypes_of(arguments_of(self.traced, self.places))

        def run(*leaves: Array) -> list[Array]:
            pairs = zip((*constants, *leaves), arguments, strict=True)
            passed = [to_pass(jnp.asarray(x, dtype)) for x, dtype in pairs]
            return received(launch(passed), self._result_dtypes)

        return run

    def _prepare(self) -> None:
        """Compile the kernel in a thread, while XLA compiles the program around it."""
        # That is for many instances: around a single one, XLA has little to compile.
        backend = default_backend()
        assert isinstance(self.one, Kernel)
        is_meant = backend and self.one.impl in ("auto", backend.IMPL) and not backend.obstacle()
        if backend and is_meant and not backend.refusal(self.one):
            backend.prepare(self.one)

    def check(self) -> None:
        """Compare the kernel with XLA on random numbers, once.

        Raises:
          KernelError: a result differs.
        """
        # What another traced function computes is not known.
        if isinstance(self.one, Kernel) and not (self._is_checked or self.places):
            check(self.one, dtypes_of(arguments_of(self.traced, self.places)), self._result_dtypes)
            self._is_checked = True

    @property
    def _result_dtypes(self) -> list[np.dtype]:
        return dtypes_of(self.traced.jaxpr.outvars)


_REST = "fix other arguments with functools.partial, and fuse the function of the rest"


def _as_array(x: PyTree, remedy: str = _REST) -> Array:
    """Return an argument or a result as an array.

    Args:
      x: the argument or the result.
      remedy: what to do with another one.

    Raises:
      TypeError: it is neither an array nor a number.
    """
    if isinstance(x, jax.Array):
        return x
    try:
        return jnp.asarray(x)
    except TypeError:
        raise TypeError(
            f"a fused function takes and returns arrays and numbers, not {x!r}: {remedy}"
        ) from None


def _without_key_constants(traced: ClosedJaxpr) -> ClosedJaxpr:
    """Return a traced function whose constants are words in place of random keys.

    Keys become constants where a function uses one from outside of it.
    """
    words = [without_key(x) if hasattr(x, "dtype") else x for x in traced.consts]
    if all(x is y for x, y in zip(words, traced.consts, strict=True)):
        return traced

    def function(*arguments: Array) -> list[Array]:
        pairs = zip(traced.consts, words, strict=True)
        consts = [with_key(x.aval, y) if hasattr(x, "aval") else x for x, y in pairs]
        return jaxpr_as_fun(ClosedJaxpr(traced.jaxpr, consts))(*arguments)

    return jax.make_jaxpr(function)(*traced.in_avals)


def _shape(x: PyTree) -> ShapedArray:
    """Return shape and dtype of a leaf, which may be a number of Python."""
    # NumPy's numbers of 64 bits are passed with 32, unless JAX is told to take them as they are.
    is_abstract = hasattr(x, "shape") and not isinstance(x, np.ndarray | np.generic)
    return ShapedArray(x.shape, x.dtype) if is_abstract else _as_array(x).aval
