"""Write the kernel that draws the actions of all environments on GPUs.

A block loops over tiles of environments: it runs the policy network as the kernels of the update
do, and then each thread draws the action of one environment.
"""

import math

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.arrays import ACTIONS, Actions
from jetbot_mjx.agents.fused.gpu_network import NetworkKernel
from jetbot_mjx.agents.fused.gpu_tiling import Tiling
from jetbot_mjx.agents.fused.shapes import DataSizes
from jetbot_mjx.agents.fused.tensor_core import Value


class ActionKernel(NetworkKernel):
    """An `ActionKernel` takes and returns the arrays of `arrays.ACTIONS`."""

    name, arguments, returns = "ppo_actions", ACTIONS.arguments, Actions._fields

    def __init__(self, tiling: Tiling, batch: DataSizes, blocks: int) -> None:
        """Prepare to write.

        Args:
          tiling: the division of the work.
          batch: the data, of which the number of environments is used.
          blocks: the number of blocks of a replica.
        """
        super().__init__(ACTIONS.shapes(tiling.shape, batch), tiling, batch, blocks)

    def begin(self) -> list[Value]:
        """Load the policy network."""
        self.load_network(self.arrays["params"], self.w.constant(self.shape.outputs[0], "u32"))
        return []

    def _environment(self, tile: Value, row: Value) -> Value:
        """Return the environment of a row of a tile, or the last one if there is none."""
        return self.w.minimum(tile * self.tiling.rows + row, self.batch.environments - 1)

    def tile(self, tile: Value, carried: list[Value]) -> list[Value]:
        """Draw the actions of a tile of environments."""
        w, shape, rows = self.w, self.shape, self.tiling.rows
        # Fetch the noise before the threads wait for each other.
        own = w.minimum(self.thread, rows - 1)
        row = w.row(self.arrays["action_noise"], self._environment(tile, own), shape.actions)
        noise = [row[i] for i in range(shape.actions)]
        observations, size = self.arrays["observations"], shape.observations
        self.load_observations(lambda row: w.row(observations, self._environment(tile, row), size))
        # All observations are there before a warp reads rows that others have loaded, and all
        # outputs before a thread reads a row that several warps have computed.
        w.synchronize()
        self.store_outputs(self.forward())
        w.synchronize()
        # The next tile writes outputs only after all threads have reached its first barrier.
        beyond = w.constant(self.batch.environments, "u32")
        environment = tile * rows + self.thread
        with w.when(w.select(self.thread < rows, environment, beyond) < beyond):
            self._draw(environment, noise)
        return carried

    def _draw(self, environment: Value, noise: list[Value]) -> None:
        """Draw the action of the thread's environment, and store it."""
        w, shape = self.w, self.shape
        # Run the program of a sample.
        outputs = self.outputs_of(self.thread, shape.outputs[0])
        sample = [*outputs, *self.deviations(), *noise]
        results = iter(w.run(sample_loss.action_program(shape, for_gpu=True), sample))
        # Store its results, which follow each other in the order of the arrays.
        for name in Actions._fields:
            size = math.prod(self.shapes[name][1:])
            row = w.row(self.arrays[name], environment, size)
            for i in range(size):
                row[i] = next(results)
