"""Identify a traced function by all that its results depend on.

A cache of compiled programs needs a key that changes whenever the program would. The text of a
jaxpr is none: it shortens arrays, leaves out the constants of inner jaxprs, and names functions by
their address. Here every equation is hashed with its parameters, every constant with its bytes, and
every kernel with its operations.
"""

import dataclasses
import enum
import hashlib
from collections.abc import Mapping
from types import FunctionType
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var

from onekernel.kernel import Kernel
from onekernel.lower import (
    Block,
    Expr,
    PlacedLoop,
    Scalar,
    ScalarProgram,
    is_constant,
)

_OF_DERIVATIVES = {"jvp_jaxpr_fun", "jvp_jaxpr_thunk", "fwd_jaxpr_thunk", "bwd", "jvp", "fwd"}
"""Parameters that only derivatives depend on."""


def fingerprint(*functions: ClosedJaxpr) -> str | None:
    """Return the SHA-256 of traced functions, in hexadecimal.

    Args:
      functions: the functions, as `jax.make_jaxpr` returns them.

    Returns:
      The hash, which is equal in another process for the same functions, settings of JAX and
      versions of JAX, MuJoCo, MJX and this package; None: a function depends on something that has
      no such hash, such as a call of Python.
    """
    hasher = _Hasher()
    try:
        for function in functions:
            hasher.add(function)
    except _UnknownError:
        return None
    return hasher.digest.hexdigest()


def _is_told_by_text(value: Any) -> bool:
    """Return whether the text of a value tells all of it; others' classes may hide something."""
    if isinstance(value, FunctionType) or " at 0x" in repr(value):
        return False
    return type(value).__module__.partition(".")[0] in ("jax", "jaxlib", "numpy")


class _UnknownError(Exception):
    """Raised where something has no hash."""


class _Hasher:
    """A `_Hasher` takes in values one after the other."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()
        # Variables and operations, by the order of their definition.
        self._numbers: dict[object, int] = {}

    def _word(self, *words: object) -> None:
        self.digest.update(f"{words}\n".encode())

    def _number(self, variable: object) -> int:
        return self._numbers.setdefault(variable, len(self._numbers))

    def add(self, value: Any) -> None:
        """Take in a value of a parameter.

        Raises:
          _UnknownError: nothing tells it from others in another process.
        """
        match value:
            case None | bool() | int() | float() | complex() | str() | bytes() | enum.Enum():
                self._word(type(value).__name__, value)
            case np.ndarray() | np.generic() | jax.Array():
                array = np.asarray(value)
                self._word("array", array.dtype.str, array.shape)
                self.digest.update(array.tobytes())
            case tuple() | list():
                self._word(type(value).__name__, len(value))
                for one in value:
                    self.add(one)
            case Mapping():
                self._word("mapping", len(value))
                for key in sorted(value, key=str):
                    self.add(key)
                    self.add(value[key])
            case ClosedJaxpr():
                self._word("constants", len(value.consts))
                for constant in value.consts:
                    self.add(constant)
                self._jaxpr(value.jaxpr)
            case Jaxpr():
                self._jaxpr(value)
            case Kernel():
                self._kernel(value)
            case np.dtype() | ShapedArray() | jax.sharding.Sharding() | jax.sharding.AbstractMesh():
                self._word(type(value).__name__, str(value))
            case _ if dataclasses.is_dataclass(value) and not isinstance(value, type):
                self._word(type(value).__name__)
                for field in dataclasses.fields(value):
                    self.add(getattr(value, field.name))
            case type():
                self._word("type", value.__module__, value.__qualname__)
            case FunctionType() if value.__module__.partition(".")[0] == "jax":
                # A user of the hash knows JAX's version.
                self._word("function of JAX", value.__module__, value.__qualname__)
            case _ if _is_told_by_text(value):
                self._word(type(value).__name__, repr(value))
            case _:
                raise _UnknownError(value)

    def _jaxpr(self, jaxpr: Jaxpr) -> None:
        self._word("jaxpr", len(jaxpr.eqns))
        for variable in (*jaxpr.constvars, *jaxpr.invars):
            self._atom(variable)
        for equation in jaxpr.eqns:
            if equation.effects:  # such as printing, by a call of Python
                raise _UnknownError(equation)
            self._word(equation.primitive.name)
            for atom in (*equation.invars, *equation.outvars):
                self._atom(atom)
            for name, value in sorted(equation.params.items()):
                if name not in _OF_DERIVATIVES:
                    self._word(name)
                    self.add(value)
        for atom in jaxpr.outvars:
            self._atom(atom)

    def _atom(self, atom: Var | Literal) -> None:
        if isinstance(atom, Literal):
            self.add(np.asarray(atom.val))
        else:
            self._word(self._number(atom))
        self._word(str(atom.aval))

    def _kernel(self, kernel: Kernel) -> None:
        if kernel.identity is not None:
            self._word("kernel", kernel.identity, kernel.steps)
            return
        if kernel.unsupported:
            raise _UnknownError(kernel)
        self._word("kernel", kernel.carried, kernel.steps, kernel.impl)
        self.add(kernel.table)
        self.add([str(x) for x in kernel.argument_dtypes or ()])
        self.add([str(x) for x in kernel.result_dtypes or ()])
        for program in (kernel.before, kernel.program, kernel.after):
            self._word(program is None)
            if program is not None:
                self._program(program)

    def _program(self, program: ScalarProgram) -> None:
        for array in program.inputs:
            self._word(array.shape)
            for x in array.flat:
                self._scalar(x)
        self._block(program.block)
        for array in program.outputs:
            self._word(array.shape)
            for x in array.flat:
                self._scalar(x)

    def _block(self, block: Block) -> None:
        self._word("block", len(block.items))
        for item in block.items:
            if isinstance(item, Expr):
                self._scalar(item)
                self._word(item.op, str(item.dtype), item.place)
                for operand in item.operands:
                    self._scalar(operand)
                continue
            if isinstance(item, PlacedLoop):
                loop = item.loop
                self._word("loop", loop.length, loop.reverse, item.places)
                parts = loop.carries, loop.initial, loop.updated, loop.results, loop.stacked
                condition = [] if loop.length is not None else [loop.condition]
                parts = *parts, condition, [loop.counter] if loop.counter is not None else []
            else:
                branch = item.branch
                self._word("branch")
                parts = [branch.condition], branch.if_false, branch.if_true
            for inner in item.blocks:
                self._block(inner)
            for scalars in (*parts, item.results):
                self._word(len(scalars))
                for x in scalars:
                    self._scalar(x)

    def _scalar(self, x: Scalar) -> None:
        if is_constant(x):
            self._word(x.dtype.str, x.tobytes())
        else:
            self._word(self._number(x))
