"""Write the kernel that computes values, advantages and value targets of a minibatch.

A tile holds whole unrolls, each followed by its last observation. When the values of all rows are
in shared memory, one thread an unroll runs backwards through it by the equation of
`jetbot_mjx.agents.gae`. The sums of the advantages and of their squares, a pair for each block, are
all that their normalisation needs.
"""

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.arrays import GRADIENT
from jetbot_mjx.agents.fused.gpu_network import NetworkKernel
from jetbot_mjx.agents.fused.gpu_tiling import Tiling
from jetbot_mjx.agents.fused.shapes import DataSizes
from jetbot_mjx.agents.fused.tensor_core import LANES, TILE, Value


class AdvantageKernel(NetworkKernel):
    """An `AdvantageKernel` takes arguments of `arrays.GRADIENT`.

    It returns the advantages and the value targets of all samples, unroll by unroll, and of each
    block the sums of its advantages and of their squares. In shared memory it also has, of float32
    with a number for each row of a tile and one behind, `values`, `td_errors` (δₜ of
    `jetbot_mjx.agents.gae`), `factors` (of Aₜ₊₁ there) and `targets`.
    """

    name = "ppo_advantages"
    arguments = (
        "params",
        "mean",
        "inverse_std",
        "rows",
        "last",
        "unroll_indices",
        "index",
        "terms",
    )
    returns = ("advantages", "targets", "statistics")

    def __init__(self, tiling: Tiling, batch: DataSizes, blocks: int) -> None:
        """Prepare to write.

        Args:
          tiling: the division of the work.
          batch: the minibatch.
          blocks: the number of blocks of a replica.
        """
        shapes = GRADIENT.shapes(tiling.shape, batch) | estimate_shapes(batch, blocks)
        super().__init__(shapes, tiling, batch, blocks)
        self.per_tile = tiling.items(batch)

    def begin(self) -> list[Value]:
        """Load the value network, and begin with sums of zero."""
        w = self.w
        index = self.arrays["index"].load("u32")
        self.unroll_indices = w.row(self.arrays["unroll_indices"], index, self.batch.unrolls)
        self.terms = self.load_terms()
        self.load_network(self.arrays["params"] + self.shape.policy_size, w.constant(1, "u32"))
        return [w.constant(0.0)] * 2

    def _unroll(self, tile: Value, row: Value) -> tuple[Value, Value]:
        """Return the unroll of a row of a tile, which may not exist, and the step in it."""
        length = self.batch.time + 1
        return tile * self.per_tile + row // length, row % length

    def _row(self, unroll: Value, step: Value) -> tuple[Value, Value]:
        """Return the unroll among the collected ones, and the pointer to the row of its step."""
        w, time = self.w, self.batch.time
        clamped = w.minimum(unroll, self.batch.unrolls - 1)
        collected = (self.unroll_indices + clamped).load("u32")
        collected_step = collected * time + w.minimum(step, time - 1)
        return collected, w.row(self.arrays["rows"], collected_step, self.shape.columns["size"])

    def tile(self, tile: Value, carried: list[Value]) -> list[Value]:
        """Compute a tile, and add the thread's advantage and its square to the sums."""
        w, shape, time = self.w, self.shape, self.batch.time
        rows = self.tiling.rows
        # Fetch what the step of the thread depends on before the threads wait for each other.
        own = w.minimum(self.thread, rows - 1)
        unroll, step = self._unroll(tile, own)
        _, start = self._row(unroll, step)
        reward, discount, truncation = (
            start[shape.columns[name]] for name in ("reward", "discount", "truncation")
        )

        def observation(row: Value) -> Value:
            unroll, step = self._unroll(tile, row)
            collected, start = self._row(unroll, step)
            last = w.row(self.arrays["last"], collected, shape.observations)
            return w.select(step < time, start, last)

        # The values of all rows.
        self.load_observations(observation)
        w.synchronize()
        self._store_values()
        w.synchronize()
        # δₜ and the factor of Aₜ₊₁, for all steps at once.
        value_step = [self.read("values", own), reward, discount, truncation]
        td_error, factor = self._error([*value_step, self.read("values", own, 1)])
        self.write("td_errors", own, td_error)
        self.write("factors", own, factor)
        w.synchronize()
        # From the last step to the first, a thread for each unroll.
        with w.when(self.thread < self.per_tile):
            self._accumulate()
        w.synchronize()
        # Âₜ is δₜ with the next target in place of the next value.
        advantage, _ = self._error([*value_step, self.read("targets", own, 1)])
        # Rows beyond the unrolls, and those of the last observations, have none.
        beyond = w.constant(self.batch.unrolls, "u32")
        unroll = w.select(own < self.per_tile * (time + 1), unroll, beyond)
        unroll = w.select(step < time, unroll, beyond)
        there = w.select(self.thread < rows, unroll, beyond) < beyond
        with w.when(there):
            place = unroll * time + step
            self.arrays["advantages"][place] = advantage
            self.arrays["targets"][place] = self.read("targets", own)
        advantage = w.select(there, advantage, 0.0)
        return [carried[0] + advantage, carried[1] + advantage * advantage]

    def _error(self, step: list[Value]) -> list[Value]:
        """Return the results of `sample_loss.value_error` for a `ValueStep`."""
        return self.w.run(sample_loss.value_error_program(), [*step, *self.terms])

    def _store_values(self) -> None:
        """Write the forward pass, and store the first output of each row."""
        row, sums = self.row + self.sum_row, self.forward()
        with self.w.when(self.sum_column.equals(0)):
            for m, (four,) in enumerate(sums):
                self.write("values", row, four[0], TILE * m)
                self.write("values", row, four[2], TILE * m + 8)

    def _accumulate(self) -> None:
        """Run backwards through an unroll, and store its value targets."""
        w, time = self.w, self.batch.time
        first = self.thread * (time + 1)
        total, gae_step = w.constant(0.0), sample_loss.gae_program()
        self.write("targets", first, self.read("values", first, time), time)
        for step in reversed(range(time)):
            td_error, factor = (self.read(name, first, step) for name in ("td_errors", "factors"))
            (total,) = w.run(gae_step, [td_error, factor, total])
            self.write("targets", first, total + self.read("values", first, step), step)

    def end(self, carried: list[Value]) -> None:
        """Add up the threads' sums in a fixed order, and store those of the block."""
        w, threads = self.w, self.tiling.threads
        for i, value in enumerate(carried):
            self.write("statistics", self.thread, value, threads * i)
        # The first warp adds up the sums of all threads, those of each lane.
        w.synchronize()
        lanes = 2 * threads
        with w.when(self.thread < LANES):
            for i in range(2):
                rows = range(threads * i, threads * (i + 1), LANES)
                total = w.total(self.read("statistics", self.thread, row) for row in rows)
                self.write("statistics", self.thread, total, lanes + LANES * i)
        # Then two threads add up those of the lanes.
        w.synchronize()
        with w.when(self.thread < 2):
            places = range(lanes, lanes + LANES)
            w.row(self.arrays["statistics"], self.block, 2)[self.thread] = w.total(
                self.read("statistics", self.thread * LANES, place) for place in places
            )


def estimate_shapes(batch: DataSizes, blocks: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays that an `AdvantageKernel` of some blocks returns."""
    return {"advantages": (batch.samples,), "targets": (batch.samples,), "statistics": (blocks, 2)}
