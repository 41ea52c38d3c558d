"""Keep a tree of arrays in one array.

Motivation: XLA compiles and launches a kernel for every array that a loop stores or carries,
however small it is. The state of an environment is twenty arrays.
"""

import dataclasses
import math
from collections.abc import Callable, Hashable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PyTree

from onekernel import Kernel

_Shape = tuple[tuple[int, ...], np.dtype]


def _is_packed(shape: tuple[int, ...], dtype: object) -> bool:
    """Return whether an array is packed: its numbers have 32 bits, and it is not empty.

    JAX's random keys are not numbers. XLA aborts when it slices an empty array out of the
    concatenation of all.
    """
    return isinstance(dtype, np.dtype) and dtype.itemsize == 4 and math.prod(shape) > 0


class Packed(struct.PyTreeNode):
    """A `Packed` holds a tree of arrays, with any batch axes in front, on host or device."""

    words: Float[Array, "*batch columns"]
    """The bits of all arrays with numbers of 32 bits, one after the other."""
    others: list[Array]
    """The other arrays."""
    structure: Hashable = struct.field(pytree_node=False)
    """Structure of the tree."""
    shapes: tuple[_Shape, ...] = struct.field(pytree_node=False)
    """Shape, without the batch axes, and dtype of each array."""

    def unpack(self) -> PyTree:
        """Return the tree."""
        others, start = iter(self.others), 0
        leaves = []
        for shape, dtype in self.shapes:
            if not _is_packed(shape, dtype):
                leaves.append(next(others))
                continue
            end = start + math.prod(shape)
            columns = self.words[..., start:end].reshape((*self.words.shape[:-1], *shape))
            # On the host, a copy does not keep the other arrays alive.
            columns = columns.copy() if isinstance(columns, np.ndarray) else columns
            leaves.append(columns.view(dtype))
            start = end
        return jax.tree.unflatten(self.structure, leaves)

    def places(self) -> PyTree:
        """Return a tree of the columns of `words` that hold each array; -1 where none does."""
        leaves, start = [], 0
        for shape, dtype in self.shapes:
            size = math.prod(shape) if _is_packed(shape, dtype) else 0
            columns = np.arange(start, start + size).reshape(shape) if size else np.full(shape, -1)
            leaves.append(columns)
            start += size
        return jax.tree.unflatten(self.structure, leaves)


@dataclasses.dataclass(frozen=True)
class PackedStep:
    """A `PackedStep` steps a batch of packed states, and knows the kernel that does it.

    Both belong to one object, so that a wrapper which steps otherwise replaces both.
    """

    step: Callable[[Packed, Array], Packed]
    """From the states of all instances and their actions to the next states."""
    kernel: Callable[[Packed], Kernel | None]
    """From a batch of states to the kernel of one instance, which takes the words of its state and
    an action and returns the words of the next state, without compiling it; None: a step is more
    than one kernel, or the next state is laid out differently."""

    def __call__(self, packed: Packed, action: Float[Array, "n action"]) -> Packed:
        """Step every instance.

        Args:
          packed: the batch of states.
          action: one action per instance.
        """
        return self.step(packed, action)


def pack(tree: PyTree, batch_axes: int = 0) -> Packed:
    """Pack a tree of arrays.

    Args:
      tree: the arrays, which all begin with the batch axes.
      batch_axes: the number of these axes.
    """
    leaves, structure = jax.tree.flatten(tree)
    shapes = tuple((x.shape[batch_axes:], x.dtype) for x in leaves)
    library = np if all(isinstance(x, np.ndarray) for x in leaves) else jnp
    packed = [_is_packed(*one) for one in shapes]
    words = [
        library.asarray(x).view(np.float32).reshape(*x.shape[:batch_axes], math.prod(shape))
        for x, (shape, _), one in zip(leaves, shapes, packed, strict=True)
        if one
    ]
    others = [x for x, one in zip(leaves, packed, strict=True) if not one]
    if not words:
        batch = leaves[0].shape[:batch_axes] if leaves else (0,) * batch_axes
        words = [library.zeros((*batch, 0), np.float32)]
    joined = library.concatenate(words, axis=-1)
    # On the host it is one of NumPy's, as the docstring of `Packed` says.
    return Packed(joined, others, structure, shapes)  # pyright: ignore[reportArgumentType]


class Condensed(struct.PyTreeNode):
    """A `Condensed` holds a tree of arrays, of which the small ones are in one array."""

    large: list[Array]
    small: Packed
    structure: Hashable = struct.field(pytree_node=False)
    """Structure of the tree."""
    is_large: tuple[bool, ...] = struct.field(pytree_node=False)
    """Whether each of its leaves is large."""

    def restore(self) -> PyTree:
        """Return the tree."""
        large, small = iter(self.large), iter(self.small.unpack())
        leaves = [next(large) if one else next(small) for one in self.is_large]
        return jax.tree.unflatten(self.structure, leaves)


def condense(tree: PyTree, most: int = 16) -> Condensed:
    """Pack the small arrays of a tree, if there are any.

    Args:
      tree: the arrays.
      most: the largest size of a small array.
    """
    leaves, structure = jax.tree.flatten(tree)
    is_large = tuple(x.size > most for x in leaves)
    large = [x for x, one in zip(leaves, is_large, strict=True) if one]
    small = [x for x, one in zip(leaves, is_large, strict=True) if not one]
    return Condensed(large, pack(small), structure, is_large)
