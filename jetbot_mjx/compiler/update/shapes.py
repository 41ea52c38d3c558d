"""Describe networks and minibatches to the kernels of PPO's update, and divide them into tiles."""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from jetbot_mjx.compiler.update.tensor_core import LANES, TILE

POLICY_METRICS = ("policy_loss", "entropy", "kl", "std")
VALUE_METRICS = ("value_loss",)
"""Sums over the samples, in the order of the vector of parameters."""

MOST_OUTPUTS = 8
"""Columns of the last layer that are computed."""
MOST_OBSERVATIONS = 64
MOST_WIDTH = 128
MOST_SUMS = 176
"""Sums of the gradient that the registers of a thread hold beside those of a layer."""

PAD = 8
"""Numbers between the rows of a matrix in shared memory, so that eight rows meet all banks."""

_GRADIENT_WARPS = 8
_WARPS = {"gradient": _GRADIENT_WARPS, "advantages": 16, "actions": 16}
"""Warps of a block, by the purpose of the kernel."""


class UpdateShape(NamedTuple):
    """An `UpdateShape` describes both networks, which have the same hidden layers, and the loss.

    Their parameters are one vector: for each network and layer the weights, of shape (inputs,
    outputs), and the biases; then the policy's standard deviations, if the distribution is
    `normal`; then room for the sums of the metrics, which the gradient's vector has there.
    """

    observations: int
    width: int
    layers: int
    """Number of hidden layers."""
    actions: int
    distribution: str
    activation: str
    normalizes: bool = True
    """Whether advantages are normalised over the minibatch."""

    @property
    def outputs(self) -> tuple[int, int]:
        """Return the outputs of the policy network and of the value network."""
        return (self.actions if self.distribution == "normal" else 2 * self.actions), 1

    @property
    def inputs(self) -> tuple[int, ...]:
        """Return the number of inputs of each layer."""
        return (self.observations, *[self.width] * self.layers)

    @property
    def hidden(self) -> int:
        """Return the number of parameters of the hidden layers of one network."""
        return sum(self.width * (inputs + 1) for inputs in self.inputs[:-1])

    @property
    def deviations(self) -> int:
        """Return the number of standard deviations that are parameters."""
        return self.actions if self.distribution == "normal" else 0

    @property
    def slots(self) -> int:
        """Return the number of sums of the policy that single samples add to."""
        return self.outputs[0] + self.deviations + len(POLICY_METRICS)

    @property
    def policy_size(self) -> int:
        """Return the length of the policy's part of the vector."""
        return self.hidden + self.width * self.outputs[0] + self.slots

    @property
    def size(self) -> int:
        """Return the length of the vector."""
        return self.policy_size + self.hidden + self.width + 1 + len(VALUE_METRICS)

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """Return the ranges of the vector that hold parameters; metrics are behind each."""
        policy = self.policy_size
        return [(0, policy - len(POLICY_METRICS)), (policy, self.size - len(VALUE_METRICS))]

    @property
    def shares(self) -> list["Shares"]:
        """Return how the warps share each hidden layer's gradient."""
        tiles = self.width // TILE
        return [Shares.of(tiles, padded(n) // TILE) for n in self.inputs[:-1]]

    @property
    def sums(self) -> int:
        """Return how many sums of the gradient of the weights a thread holds."""
        return sum(8 * share.row_tiles * share.pairs for share in self.shares)

    @property
    def drawn(self) -> list[int]:
        """Return how many numbers of each array of `launch.Actions` an environment has."""
        return [math.prod(shape) for shape in self.drawn_shapes(1)]

    def drawn_shapes(self, environments: int) -> list[tuple[int, ...]]:
        """Return the shapes of the arrays of `launch.Actions`."""
        each = environments, self.actions
        return [each, each, (environments,), (environments, 2 * self.actions)]

    @property
    def columns(self) -> dict[str, int]:
        """Return where the parts of a row of the collected data begin, and its `size`."""
        sizes = {
            "observation": self.observations,
            "raw_action": self.actions,
            "log_prob": 1,
            "distribution": 2 * self.actions,
            "reward": 1,
            "discount": 1,
            "truncation": 1,
        }
        starts = _starts(sizes)
        return {**dict(zip(sizes, starts, strict=False)), "size": starts[-1]}


class Minibatch(NamedTuple):
    """A `Minibatch` says how many unrolls there are."""

    collected: int
    """Unrolls among which the minibatch's are."""
    unrolls: int
    time: int
    """Steps of an unroll."""
    count: int = 1
    """Number of minibatches of a training step, in all passes."""

    @property
    def samples(self) -> int:
        """Return the number of samples of the minibatch."""
        return self.unrolls * self.time


class LossTerms(NamedTuple):
    """A `LossTerms` holds the coefficients of the loss, under the names of the configuration.

    The kernels read them from an array, because they may differ between policies.
    """

    clipping_epsilon: Any
    entropy_cost: Any
    vf_loss_coefficient: Any
    discounting: Any
    gae_lambda: Any
    reward_scaling: Any


class Shares(NamedTuple):
    """A `Shares` says which tiles of a gradient's matrix a warp sums up.

    Where the tiles cannot be divided evenly, several warps compute and store the same ones.
    """

    row_tiles: int
    """Tiles of 16 rows of a warp."""
    pairs: int
    """Pairs of column tiles, 16 columns, of a warp."""
    groups: int
    """Groups of rows."""

    @classmethod
    def of(cls, rows: int, pairs: int) -> "Shares":
        """Return the shares with the fewest sums and, of these, with the fewest loads."""
        options = []
        for row_tiles in range(1, rows + 1):
            groups = -(-rows // row_tiles)
            if groups <= _GRADIENT_WARPS:
                per_warp = -(-pairs // (_GRADIENT_WARPS // groups))
                options.append(cls(row_tiles, per_warp, groups))
        return min(options, key=lambda x: (x.row_tiles * x.pairs, x.row_tiles + x.pairs))


@dataclasses.dataclass(frozen=True)
class Tiling:
    """A `Tiling` divides the work of a block among its warps."""

    shape: UpdateShape
    rows: int
    """Rows of a tile, one for each observation."""
    row_tiles: int
    """Row tiles of a warp in a layer's product."""
    purpose: str = "gradient"
    """What the kernel computes: `gradient`, `advantages` or `actions`."""

    @property
    def warps(self) -> int:
        """Return the number of warps of a block."""
        return _WARPS[self.purpose]

    @property
    def threads(self) -> int:
        """Return the number of threads of a block."""
        return self.warps * LANES

    @property
    def row_groups(self) -> int:
        """Return how many groups of warps share a tile's rows."""
        return self.rows // (TILE * self.row_tiles)

    @property
    def column_groups(self) -> int:
        """Return how many warps share a group's columns."""
        return self.warps // self.row_groups

    @property
    def is_gradient(self) -> bool:
        """Return whether all layers are kept, for a backward pass."""
        return self.purpose == "gradient"

    @property
    def extras(self) -> int:
        """Return how many numbers of a sample beside the observation a row holds; it is odd."""
        return 4 * self.shape.actions + 3

    @functools.cached_property
    def layout(self) -> dict[str, int]:
        """Return the byte of shared memory where each array begins, and their `size`."""
        shape, rows = self.shape, self.rows
        stride = shape.width + PAD
        first, outputs = padded(shape.observations), 4 * rows * (MOST_OUTPUTS + 1)
        sizes = {f"weights{i}": 2 * padded(n) * stride for i, n in enumerate(shape.inputs[:-1])}
        sizes["head"] = 2 * shape.width * (TILE + PAD)
        sizes |= {f"biases{i}": 4 * shape.width for i in range(shape.layers)}
        sizes |= {"head_biases": 4 * MOST_OUTPUTS, "mean": 4 * first, "scale": 4 * first}
        sizes["layer0"] = 2 * rows * (first + PAD)
        if self.is_gradient:
            sizes |= {f"layer{i + 1}": 2 * rows * stride for i in range(shape.layers)}
            if shape.activation == "swish":
                sizes |= {f"slopes{i + 1}": 2 * rows * stride for i in range(shape.layers)}
            sizes["outputs"] = outputs
            sizes["errors"] = 2 * rows * (TILE + PAD)
            sizes["extras"] = 4 * rows * self.extras
            sizes["statistics"] = 4 * (2 * LANES + 2)
            sizes["slots"] = 4 * shape.slots * (rows + 1)
        elif self.purpose == "actions":
            sizes |= {"layer1": 2 * rows * stride, "outputs": outputs}
        else:
            sizes["layer1"] = 2 * rows * stride
            sizes |= dict.fromkeys(("values", "deltas", "factors", "targets"), 4 * (rows + 1))
            sizes["statistics"] = 4 * 2 * (self.threads + LANES)
        starts = _starts({name: -(-size // 16) * 16 for name, size in sizes.items()})
        return {**dict(zip(sizes, starts, strict=False)), "size": starts[-1]}


def gradient_tiling(shape: UpdateShape, shared_memory: int) -> Tiling | None:
    """Return the tiling of the gradient with the largest tile that fits.

    Args:
      shape: the networks.
      shared_memory: bytes of shared memory that a block may have.

    Returns:
      The tiling; None: not even the smallest tile fits.
    """
    tilings = [Tiling(shape, 128, 2), Tiling(shape, 64, 1), Tiling(shape, 32, 1)]
    return next((x for x in tilings if x.layout["size"] <= shared_memory), None)


def advantage_tiling(
    shape: UpdateShape, batch: Minibatch, blocks: int, shared_memory: int
) -> Tiling | None:
    """Return the tiling of the advantages that is likely fastest.

    Args:
      shape: the networks.
      batch: the minibatch.
      blocks: the number of blocks that run at the same time.
      shared_memory: bytes of shared memory that a block may have.

    Returns:
      The tiling; None: no tile that holds an unroll fits.
    """
    tilings = [Tiling(shape, n, -(-n // 128), "advantages") for n in (256, 128, 64)]
    return _fastest(
        (x for x in tilings if x.rows > batch.time),
        lambda rows: -(-batch.unrolls // (rows // (batch.time + 1))),
        blocks,
        shared_memory,
    )


def action_tiling(
    shape: UpdateShape, environments: int, blocks: int, shared_memory: int
) -> Tiling | None:
    """Return the tiling of the actions that is likely fastest.

    Args:
      shape: the networks.
      environments: the number of environments.
      blocks: the number of blocks that run at the same time.
      shared_memory: bytes of shared memory that a block may have.

    Returns:
      The tiling; None: not even the smallest tile fits.
    """
    tilings = [Tiling(shape, n, -(-n // 128), "actions") for n in (256, 128, 64, 32)]
    return _fastest(tilings, lambda rows: -(-environments // rows), blocks, shared_memory)


def _fastest(
    tilings: Iterable[Tiling], tiles: Callable[[int], int], blocks: int, shared_memory: int
) -> Tiling | None:
    """Return the tiling that fits and is likely fastest, from the number of tiles by their rows."""
    fitting = [x for x in tilings if x.layout["size"] <= shared_memory]

    def cost(tiling: Tiling) -> int:
        # A tile takes some time for its barriers, whatever its size.
        return -(-tiles(tiling.rows) // blocks) * (tiling.rows + 64)

    return min(fitting, key=cost, default=None)


def padded(number: int) -> int:
    """Return a number rounded up to whole tiles."""
    return -(-number // TILE) * TILE


def _starts(sizes: dict[str, int]) -> list[int]:
    """Return where parts of the given sizes begin, one after the other, and the end."""
    starts = [0]
    for size in sizes.values():
        starts.append(starts[-1] + size)
    return starts
