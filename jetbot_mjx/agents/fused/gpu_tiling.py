"""Divide the work of the kernels on GPUs into tiles, and a tile among the warps of a block."""

import dataclasses
import functools
from typing import NamedTuple

from jetbot_mjx.agents.fused.shapes import DataSizes, UpdateShape, places
from jetbot_mjx.agents.fused.tensor_core import LANES, TILE

MOST_OUTPUTS = 8
"""Columns of the last layer that are computed."""
OUTPUT_STRIDE = MOST_OUTPUTS + 1
"""Numbers from one sample's outputs to those of the next in shared memory."""
MOST_OBSERVATIONS = 64
MOST_WIDTH = 128
MOST_SUMS = 176
"""Sums of the gradient that a thread can hold. It has 255 registers, of which the sums of a layer's
product take up to 64, and addresses and operands the others."""

PAD = 8
"""Numbers between the rows of a matrix in shared memory, so that eight rows meet all banks."""

_WARPS = {"gradient": 8, "advantages": 16, "actions": 16}
"""Warps of a block, by the purpose of the kernel."""

_ROWS = {"gradient": (128, 64, 32), "advantages": (256, 128, 64), "actions": (256, 128, 64, 32)}
"""Rows that a tile may have, likewise."""


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
        # Groups of warps share the rows, and the warps of a group the columns.
        options, warps = [], _WARPS["gradient"]
        for row_tiles in range(1, rows + 1):
            groups = -(-rows // row_tiles)
            if groups <= warps:
                options.append(cls(row_tiles, -(-pairs // (warps // groups)), groups))
        return min(options, key=lambda x: (x.row_tiles * x.pairs, x.row_tiles + x.pairs))


def shares_of(shape: UpdateShape) -> list[Shares]:
    """Return how the warps share each hidden layer's gradient."""
    tiles = shape.width // TILE
    return [Shares.of(tiles, padded(n) // TILE) for n in shape.inputs[:-1]]


def sums_of(shape: UpdateShape) -> int:
    """Return how many sums of the gradient of the weights a thread holds."""
    return sum(8 * share.row_tiles * share.pairs for share in shares_of(shape))


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

    def items(self, batch: DataSizes) -> int:
        """Return how many samples, environments, or whole unrolls a tile holds."""
        # Each unroll is followed by its last observation.
        return self.rows // (batch.time + 1) if self.purpose == "advantages" else self.rows

    def tiles(self, batch: DataSizes) -> int:
        """Return the number of tiles of all data."""
        every = {"advantages": batch.unrolls, "actions": batch.environments}
        return -(-every.get(self.purpose, batch.samples) // self.items(batch))

    @property
    def extras(self) -> int:
        """Return how many numbers of a sample beside the observation a row holds.

        They are odd, so that neighbouring threads, one for each row, access different banks.
        """
        return 4 * self.shape.actions + 3

    @property
    def stores_slopes(self) -> bool:
        """Return whether slopes are stored: they do not follow from the activations."""
        return self.is_gradient and self.shape.activation == "swish"

    @functools.cached_property
    def layout(self) -> dict[str, int]:
        """Return the byte of shared memory where each array begins, and their `size`."""
        return places(self.sizes, 16)

    @functools.cached_property
    def sizes(self) -> dict[str, int]:
        """Return the bytes of each array in shared memory."""
        # Every kernel: the network, float16 but for biases and statistics, and the observations.
        shape, rows = self.shape, self.rows
        stride = shape.width + PAD
        first, outputs = padded(shape.observations), 4 * rows * OUTPUT_STRIDE
        sizes = {f"weights{i}": 2 * padded(n) * stride for i, n in enumerate(shape.inputs[:-1])}
        sizes["head"] = 2 * shape.width * (TILE + PAD)
        sizes |= {f"biases{i}": 4 * shape.width for i in range(shape.layers)}
        sizes |= {"head_biases": 4 * MOST_OUTPUTS, "mean": 4 * first, "inverse_std": 4 * first}
        sizes["layer0"] = 2 * rows * (first + PAD)
        # All layers for a backward pass, or one, in which each replaces the one before.
        layers = range(1, 1 + (shape.layers if self.is_gradient else 1))
        sizes |= {f"layer{i}": 2 * rows * stride for i in layers}
        if self.is_gradient:
            # The loss's operands and results for each row, the statistics of the advantages, and a
            # sum for each row and slot.
            if self.stores_slopes:
                sizes |= {f"slopes{i}": 2 * rows * stride for i in layers}
            sizes["outputs"] = outputs
            sizes["errors"] = 2 * rows * (TILE + PAD)
            sizes["extras"] = 4 * rows * self.extras
            sizes["statistics"] = 4 * (2 * LANES + 2)
            sizes["slots"] = 4 * shape.slots * (rows + 1)
        elif self.purpose == "actions":
            sizes["outputs"] = outputs
        else:
            # A number of each kind for each row and one behind it, and a pair of sums for each
            # thread and each lane.
            sizes |= dict.fromkeys(("values", "td_errors", "factors", "targets"), 4 * (rows + 1))
            sizes["statistics"] = 4 * 2 * (self.threads + LANES)
        return sizes


def best_tiling(
    purpose: str, shape: UpdateShape, batch: DataSizes, blocks: int, shared_memory: int
) -> Tiling | None:
    """Return the tiling that fits and is likely fastest.

    Args:
      purpose: what the kernel computes, as in `Tiling`.
      shape: the networks.
      batch: the sizes of the data.
      blocks: the number of blocks that run at the same time.
      shared_memory: bytes of shared memory that a block may have.

    Returns:
      The tiling; None: no tile fits, or none holds an unroll.
    """
    warps = _WARPS[purpose]
    tilings = (Tiling(shape, n, -(-n // (8 * warps)), purpose) for n in _ROWS[purpose])
    fitting = [x for x in tilings if x.layout["size"] <= shared_memory and x.items(batch)]

    def cost(tiling: Tiling) -> int:
        # The gradient takes the largest tiles, which need the fewest barriers for each sample.
        if tiling.is_gradient:
            return -tiling.rows
        # The others are short, and should leave no multiprocessor without work: the time of the
        # block with the most tiles, each of which takes as long as 64 rows for its barriers.
        most_tiles = -(-tiling.tiles(batch) // blocks)
        return most_tiles * (tiling.rows + 64)

    return min(fitting, key=cost, default=None)


def padded(number: int) -> int:
    """Return a number rounded up to whole tiles."""
    return -(-number // TILE) * TILE
