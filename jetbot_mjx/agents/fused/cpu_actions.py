"""Write the kernels of a collection on CPUs: the actions of all environments, or whole unrolls.

In an unroll, few environments at a time go through all steps, actions and physics in turns. Their
states stay in the cache, the weights are arranged once, and no thread waits for another, while a
call for each step would wake all threads twice.
"""

from collections.abc import Mapping

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.arrays import ACTIONS, Actions
from jetbot_mjx.agents.fused.cpu_network import HEAD, MOST_PARTS, TILE_ROWS, NetworkStage
from jetbot_mjx.agents.fused.cpu_stages import sample_function
from jetbot_mjx.agents.fused.sample_loss import vector_of
from jetbot_mjx.agents.fused.shapes import DataSizes, UnrollSpec, UpdateShape
from onekernel.build import LlvmWriter, Value, cpu, scalarize


class ActionStage(NetworkStage):
    """An `ActionStage` runs the policy network and draws an action from each distribution."""

    name = "actions"

    part_rows = 2 * TILE_ROWS
    """Environments of a part, unless there would be too many parts; each copies the weights."""

    def __init__(self, shape: UpdateShape, batch: DataSizes, lanes: int) -> None:
        """Divide the environments.

        Args:
          shape: the networks.
          batch: the data, of which the number of environments is used.
          lanes: the number of float32 values in a vector register.
        """
        numbers = ACTIONS.counts(shape, DataSizes(environments=1))
        self.result_sizes = {name: numbers[name] for name in Actions._fields}
        """The numbers of an environment in each array of `Actions`."""
        part_items = max(self.part_rows, -(-batch.environments // MOST_PARTS))
        super().__init__(shape, lanes, batch.environments, part_items)

    def scratch_sizes(self) -> dict[str, int]:
        """Add what the samples read and write, a row of lanes for each number."""
        reads = self.outputs + 2 * self.shape.actions
        writes = sum(self.result_sizes.values())
        sizes = {"sample": reads * self.lanes, "results": writes * self.lanes}
        return super().scratch_sizes() | sizes

    def own_functions(self) -> list[LlvmWriter]:
        """Write the activation and the sample."""
        name = self.shape.activation
        activated = scalarize(lambda z: sample_loss.activation(name, z)[0], vector_of())
        return [
            self.on_layers("activate", activated, (0,), (0,)),
            sample_function("draw", sample_loss.action_program(self.shape), self.lanes),
        ]

    def tile(self, first: Value, count: Value) -> None:
        """Draw the actions of some environments."""
        self.act(first, count, self.arrays, self.shape.observations)

    def act(self, first: Value, count: Value, arrays: Mapping[str, Value], stride: int) -> None:
        """Draw the actions of some environments.

        Args:
          first: the first environment.
          count: their number.
          arrays: the addresses of the observations, the noise and the results of all environments.
          stride: numbers from one observation to the next.
        """
        # Take the observations through the network, a row for each environment,
        w = self.w
        with w.loop(count) as row:
            place = (first + row) * stride
            self.load_observation(arrays["observations"] + place, row)
        self.forward(self.stored_rows(count))
        # and draw the actions, a lane for each environment.
        places, actions = self.places, self.shape.actions
        with self.groups(count) as start:
            there = w.minimum(count - start, w.lanes)
            # Collect what the samples read; lanes beyond the last environment repeat it.
            with w.loop(w.lanes) as lane:
                row = start + w.minimum(lane, there - 1)
                outputs = places["outputs"] + row * HEAD
                noise = arrays["action_noise"] + (first + row) * actions
                sources = (outputs, self.outputs), (self.deviations, actions), (noise, actions)
                self.gather("sample", lane, sources)
            w.call("draw", places["sample"], places["results"])
            # Store the actions, the numbers of each array behind those of the one before.
            with w.loop(there) as lane:
                results = places["results"] + lane
                for name, size in self.result_sizes.items():
                    target = arrays[name] + (first + start + lane) * size
                    for i in range(size):
                        target[i] = results[i * w.lanes]
                    results += size * w.lanes


class UnrollStage(ActionStage):
    """An `UnrollStage` takes environments through all steps of an unroll."""

    name = "unroll"
    # The parts are smaller than those of one step: each arranges the weights for all steps.
    part_rows = TILE_ROWS

    def __init__(self, unroll: UnrollSpec, batch: DataSizes, lanes: int) -> None:
        """Divide the environments.

        Args:
          unroll: the networks and the environment.
          batch: the data, of which the number of environments and the time are used.
          lanes: the number of float32 values in a vector register.
        """
        self._unroll, self._time = unroll, batch.time
        super().__init__(unroll.shape, batch, lanes)

    def scratch_sizes(self) -> dict[str, int]:
        """Add the arrays of a step."""
        count = cpu.scratch_bytes(self._unroll.kernel, self.lanes) // 4
        return super().scratch_sizes() | ({"arrays": count} if count else {})

    def own_functions(self) -> list[LlvmWriter]:
        """Write the activation, the sample and the step of the environments."""
        return [*super().own_functions(), *cpu.step_functions(self._unroll.kernel, self.lanes)]

    def tile(self, first: Value, count: Value) -> None:
        """Take some environments through all steps."""
        w, unroll, end = self.w, self._unroll, self.arrays["end"]
        limit = first + count
        with w.loop(self._time) as step:
            # Find the step's part of each array, and the states before it.
            here = {
                name: self.arrays[name] + step * (self.sizes[name] // self._time)
                for name in ("kept", "unroll_noise", *self.result_sizes)
            }
            before = w.select(step.equals(0), self.arrays["start"], end)
            here["observations"] = before + unroll.observation
            here["action_noise"] = here["unroll_noise"]
            # Draw the actions, and step the environments.
            self.act(first, count, here, unroll.state)
            with self.groups(count) as start:
                memory = [self.places["arrays"]] if "arrays" in self.places else []
                w.call("instances", before, here["action"], end, first + start, limit, *memory)
            # Copy what is kept of the states.
            with w.loop(count) as row:
                environment = first + row
                source = end + environment * unroll.state
                target = here["kept"] + environment * len(unroll.kept)
                for place, number in enumerate(unroll.kept):
                    target[place] = source[number]
