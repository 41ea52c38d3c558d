"""Write the kernel that draws the actions of all environments on GPUs.

A block loops over tiles of environments: it runs the policy network as the kernels of the update
do, and then each thread draws the action of one environment.
"""

from jetbot_mjx.compiler.update.distribution import OUTPUT_BYTES, Distribution, log_prob
from jetbot_mjx.compiler.update.network import NetworkKernel
from jetbot_mjx.compiler.update.shapes import Minibatch, Tiling
from jetbot_mjx.compiler.update.tensor_core import Value

NAME = "ppo_actions"
"""Name of the kernel."""


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
        super().__init__(tiling, batch, tile_count(tiling, environments))

    def write(self) -> str:
        ir, shape, count = self.ir, self.shape, self.batch.unrolls
        self.prepare()
        seed = ir.register("ctaid.z")
        sizes = [shape.size, shape.observations, shape.observations]
        sizes += [count * shape.observations, count * shape.actions]
        sizes += [count * size for size in shape.drawn]
        self.arrays = [self.argument(i, seed, size) for i, size in enumerate(sizes)]
        params, mean, scale = self.arrays[:3]
        self.load_network(params, ir.constant(shape.outputs[0], "i32"), mean, scale)
        ir.synchronize()
        tile = self.begin_tiles()
        self._tile(tile)
        self.end_tiles(tile, [])
        return self.text(NAME, len(sizes))

    def _environment(self, tile: Value, row: Value) -> Value:
        """Return the environment of a row of a tile, or the last one if there is none."""
        return self.ir.minimum(tile * self.tiling.rows + row, self.batch.unrolls - 1)

    def _tile(self, tile: Value) -> None:
        ir, shape, rows = self.ir, self.shape, self.tiling.rows
        own = ir.minimum(self.thread, rows - 1)
        drawn = ir.row(self.arrays[4], self._environment(tile, own), shape.actions)
        noise = [ir.fetch(drawn, ir.constant(i, "i32")) for i in range(shape.actions)]
        observations = self.arrays[3]
        self.load_observations(
            lambda row: ir.row(observations, self._environment(tile, row), shape.observations)
        )()
        ir.synchronize()
        self.store_outputs(self.forward())
        ir.synchronize()
        # The next tile writes outputs only after all threads have reached its first barrier.
        beyond = ir.constant(self.batch.unrolls, "i32")
        environment = tile * rows + self.thread
        with ir.when(ir.select(self.thread < rows, environment, beyond) < beyond):
            self._draw(environment, noise)

    def _draw(self, environment: Value, noise: list[Value]) -> None:
        """Draw the action of the thread's environment, and store it."""
        ir, shape, actions = self.ir, self.shape, range(self.shape.actions)
        tanh = shape.distribution == "tanh_normal"
        outputs = ir.shared(self.thread * OUTPUT_BYTES, self.bytes_of("outputs"))
        mean, scale, raw_scale = Distribution.of(ir, shape, outputs, self.arrays[0])
        raw = [noise[i] * scale[i] + mean[i] for i in actions]
        # From the rounded action, as the update computes it.
        distances = [(raw[i] - mean[i]) * ir.reciprocal(scale[i]) for i in actions]
        log = log_prob(ir, distances, [ir.log(x) for x in scale], raw if tanh else [])
        # The tanh of the activations is not exact enough for actions.
        action = [2.0 * ir.sigmoid(x * 2.0) - 1.0 for x in raw] if tanh else raw
        results = action, raw, [log], [*mean, *(raw_scale if tanh else scale)]
        for array, size, values in zip(self.arrays[5:], shape.drawn, results, strict=True):
            row = ir.row(array, environment, size)
            for i, value in enumerate(values):
                ir.put(value, row, ir.constant(i, "i32"))
