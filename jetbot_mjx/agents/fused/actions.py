"""Write the kernel that draws the actions of all environments on GPUs.

A block loops over tiles of environments: it runs the policy network as the kernels of the update
do, and then each thread draws the action of one environment.
"""

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.gpu_tiling import Tiling
from jetbot_mjx.agents.fused.network import NetworkKernel
from jetbot_mjx.agents.fused.shapes import Minibatch
from jetbot_mjx.agents.fused.tensor_core import Value

NAME = "ppo_actions"
"""Name of the kernel."""

_DRAWN = 5
"""Place of the first of the arrays that it writes."""


def tile_count(tiling: Tiling, environments: int) -> int:
    """Return the number of tiles."""
    return -(-environments // tiling.rows)


def actions_text(tiling: Tiling, environments: int) -> str:
    """Write the kernel.

    Its arguments are the parameters, mean and 1 / std of the observations, the observations, and
    noise; its results are the arrays of `launch.Actions`.

    Args:
      tiling: the division of the work.
      environments: the number of environments of a policy.

    Returns:
      The text of an LLVM module; its launch needs `tiling.layout["size"]` bytes of shared memory.
    """
    return _ActionKernel(tiling, environments).write()


class _ActionKernel(NetworkKernel):
    def __init__(self, tiling: Tiling, environments: int) -> None:
        batch = Minibatch(environments, environments, 1)
        arrays = _DRAWN + len(tiling.shape.drawn)
        super().__init__(NAME, arrays, tiling, batch, tile_count(tiling, environments))

    def write(self) -> str:
        ir, shape, count = self.ir, self.shape, self.batch.unrolls
        # The arrays of the policy, which the third axis of the grid says.
        self.prepare()
        seed = ir.register("ctaid.z")
        sizes = [shape.size, shape.observations, shape.observations]
        sizes += [count * shape.observations, count * shape.actions]
        sizes += [count * size for size in shape.drawn]
        self.arrays = [self.argument(i, seed, size) for i, size in enumerate(sizes)]
        # Load the network once, and then take the tiles through it.
        params, mean, scale = self.arrays[:3]
        self.load_network(params, ir.constant(shape.outputs[0], "u32"), mean, scale)
        ir.synchronize()
        with ir.repeat(self.block) as loop:
            (tile,) = loop.carried
            self._tile(tile)
            self.next_tile(loop, tile)
        return self.module()

    def _environment(self, tile: Value, row: Value) -> Value:
        """Return the environment of a row of a tile, or the last one if there is none."""
        return self.ir.minimum(tile * self.tiling.rows + row, self.batch.unrolls - 1)

    def _tile(self, tile: Value) -> None:
        ir, shape, rows = self.ir, self.shape, self.tiling.rows
        # Fetch the noise before the threads wait for each other.
        own = ir.minimum(self.thread, rows - 1)
        drawn = ir.row(self.arrays[4], self._environment(tile, own), shape.actions)
        noise = [drawn[i] for i in range(shape.actions)]
        observations = self.arrays[3]
        self.load_observations(
            lambda row: ir.row(observations, self._environment(tile, row), shape.observations)
        )()
        ir.synchronize()
        self.store_outputs(self.forward())
        ir.synchronize()
        # The next tile writes outputs only after all threads have reached its first barrier.
        beyond = ir.constant(self.batch.unrolls, "u32")
        environment = tile * rows + self.thread
        with ir.when(ir.select(self.thread < rows, environment, beyond) < beyond):
            self._draw(environment, noise)

    def _draw(self, environment: Value, noise: list[Value]) -> None:
        """Draw the action of the thread's environment, and store it."""
        ir, shape = self.ir, self.shape
        # Run the program of a sample.
        # Run the program of a sample.
        outputs = self.outputs_of(self.thread, shape.outputs[0])
        sample = [*outputs, *self.deviations(self.arrays[0]), *noise]
        results = iter(ir.run(sample_loss.action_program(shape, for_gpu=True), sample))
        # Store its results, which follow each other in the order of the arrays.
        for array, size in zip(self.arrays[_DRAWN:], shape.drawn, strict=True):
            row = ir.row(array, environment, size)
            for i in range(size):
                row[i] = next(results)
