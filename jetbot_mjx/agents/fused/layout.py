"""Lay the parameters of both networks out as one vector, in which Adam's moments lie likewise."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import Array, Float, PyTree

from jetbot_mjx.agents.fused.shapes import POLICY_METRICS, VALUE_METRICS, UpdateShape
from jetbot_mjx.agents.learner import Layout
from jetbot_mjx.agents.networks import NetworkParams

_Places = dict[tuple[str, ...], tuple[slice, tuple[int, ...]]]
"""Where a vector holds each parameter, and its shape, by the keys of the network and of the
dictionaries in it."""


class VectorLayout(Layout):
    """A `VectorLayout` has a vector in place of every `NetworkParams`.

    Between the parameters there is room for the sums of the metrics, which is zero.
    """

    def __init__(self, shape: UpdateShape) -> None:
        """Find the places of the parameters.

        Args:
          shape: the networks.
        """
        self._size = shape.size
        self._places = _places(shape)

    def pack(self, tree: PyTree) -> PyTree:
        """Return a tree with a vector in place of every `NetworkParams`, on host or device."""
        return jax.tree.map(
            lambda x: self._vector(x) if isinstance(x, NetworkParams) else x,
            tree,
            is_leaf=lambda x: isinstance(x, NetworkParams),
        )

    def unpack(self, tree: PyTree) -> PyTree:
        """Return a tree with `NetworkParams` in place of every vector of that length."""
        return jax.tree.map(lambda x: self._params(x) if x.shape == (self._size,) else x, tree)

    def _vector(self, params: NetworkParams) -> Float[Array | np.ndarray, " size"]:
        """Return the vector that holds the parameters."""
        leaves: PyTree = flatten_dict({"policy": params.policy, "value": params.value})
        is_on_host = isinstance(next(iter(leaves.values())), np.ndarray)
        concatenate = np.concatenate if is_on_host else jnp.concatenate
        parts, end = [], 0
        for path, (place, _) in self._places.items():
            # The room for metrics before it, if any, and the parameter.
            parts += [np.zeros(place.start - end, np.float32), leaves[path].reshape(-1)]
            end = place.stop
        return concatenate([*parts, np.zeros(self._size - end, np.float32)])

    def _params(self, vector: Float[Array, " size"]) -> NetworkParams:
        """Return the parameters that a vector holds."""
        places = self._places.items()
        leaves = {path: vector[place].reshape(shape) for path, (place, shape) in places}
        return NetworkParams(**unflatten_dict(leaves))


def _places(shape: UpdateShape) -> _Places:
    """Return where each parameter lies, in the order of the vector."""
    places: _Places = {}
    start = 0

    def add(path: tuple[str, ...], *sizes: int) -> None:
        nonlocal start
        end = start + math.prod(sizes)
        places[network, "params", *path] = slice(start, end), sizes
        start = end

    for network, outputs, metrics in zip(
        ("policy", "value"), shape.outputs, (POLICY_METRICS, VALUE_METRICS), strict=True
    ):
        # Brax's policy with a `normal` distribution has other names.
        by_mean = shape.distribution == "normal" and network == "policy"
        for layer, inputs in enumerate(shape.inputs):
            # The hidden layers, and then the head, whose size is that of the outputs.
            path = (*(["MLP_0"] if by_mean else []), f"hidden_{layer}")
            size = shape.width
            if layer == shape.layers:
                path, size = (("Dense_0",) if by_mean else path), outputs
            add((*path, "kernel"), inputs, size)
            add((*path, "bias"), size)
        # Standard deviations that are parameters themselves.
        if by_mean:
            add(("std_param", "value"), shape.actions)
        # Room for the sums of the network's metrics.
        start += len(metrics)
    return places
