"""Write the kernel that draws the actions of all environments on CPUs."""

from collections.abc import Iterator, Mapping

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.arrays import ACTIONS, Actions
from jetbot_mjx.agents.fused.cpu_network import HEAD, MOST_PARTS, TILE_ROWS, NetworkStage
from jetbot_mjx.agents.fused.cpu_product import rounded_up
from jetbot_mjx.agents.fused.cpu_stages import Stages, sample_function
from jetbot_mjx.agents.fused.sample_loss import vector_of
from jetbot_mjx.agents.fused.shapes import Minibatch, UpdateShape
from onekernel import scalarize
from onekernel.build import LlvmWriter, Value

_PART_ROWS = 2 * TILE_ROWS
"""Environments of a part if there are no more than `MOST_PARTS` times as many; each part copies the
weights."""


def action_stages(shape: UpdateShape, batch: Minibatch, lanes: int) -> Stages:
    """Return the stage of `arrays.ACTIONS`.

    Args:
      shape: the networks.
      batch: the data, of which the number of environments is used.
      lanes: the number of float32 values in a vector register.
    """
    return Stages([ActionStage(shape, batch.environments, lanes, _PART_ROWS)])


class ActionStage(NetworkStage):
    """An `ActionStage` runs the policy network and draws an action from each distribution."""

    name = "actions"
    arrays_of = (*ACTIONS.arguments, *ACTIONS.returns)

    def __init__(self, shape: UpdateShape, environments: int, lanes: int, part_rows: int) -> None:
        """Divide the environments.

        Args:
          shape: the networks.
          environments: the number of environments.
          lanes: the number of float32 values in a vector register.
          part_rows: the environments of a part, unless there would be too many parts.
        """
        self.environments = environments
        numbers = ACTIONS.counts(shape, Minibatch(environments=1))
        self.drawn = {name: numbers[name] for name in Actions._fields}
        """The numbers of an environment in each array of `Actions`."""
        part_items = max(part_rows, -(-environments // MOST_PARTS))
        super().__init__(shape, lanes, environments, part_items)

    def scratch_sizes(self) -> dict[str, int]:
        """Add what the samples read and write, a row of lanes for each number."""
        reads = self.outputs + 2 * self.shape.actions
        sizes = {"sample": reads * self.lanes, "drawn": sum(self.drawn.values()) * self.lanes}
        return super().scratch_sizes() | sizes

    def own_functions(self) -> list[LlvmWriter]:
        """Write the activation and the sample."""
        activate = self.activation()
        activated = scalarize(lambda z: activate(z)[0], vector_of())
        drawn = sample_loss.action_program(self.shape)
        return [
            self.on_layers("activate", activated, (0,), (0,)),
            sample_function("draw", drawn, self.lanes),
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
        w = self.w
        with w.loop(count) as row:
            place = (first + row) * stride
            self.load_observation(arrays["observations"] + place, row)
        self.forward(self.stored_rows(count))
        for start in self.groups(count):
            there = w.minimum(count - start, w.lanes)
            self._draw(first + start, start, there, arrays)

    def groups(self, count: Value) -> Iterator[Value]:
        """Repeat what is appended for as many environments at once as a vector has lanes.

        Args:
          count: the number of environments.

        Yields:
          The first one of the group.
        """
        lanes = self.w.lanes
        with self.w.loop(rounded_up(count, lanes)) as group:
            yield group * lanes

    def _draw(self, first: Value, start: Value, there: Value, arrays: Mapping[str, Value]) -> None:
        """Draw the actions of a group of environments.

        Args:
          first: the first environment.
          start: its row.
          there: the number of environments.
          arrays: those of `act`.
        """
        w, shape, places = self.w, self.shape, self.places
        lanes, actions = w.lanes, shape.actions
        deviations = self.params + (shape.hidden + (shape.width + 1) * self.outputs)
        # Collect what the samples read, environment by environment.
        with w.loop(lanes) as lane:
            # Lanes beyond the last environment repeat it.
            within = w.minimum(lane, there - 1)
            outputs = places["outputs"] + (start + within) * HEAD
            noise = (first + within) * actions
            sources = [
                (outputs, self.outputs),
                (deviations if shape.deviations else outputs, actions),
                (arrays["action_noise"] + noise, actions),
            ]
            target = places["sample"] + lane
            numbers = [(source, i) for source, count in sources for i in range(count)]
            for place, (source, i) in enumerate(numbers):
                target[place * lanes] = source[i]
        w.call("draw", places["sample"], places["drawn"])
        # Store what they draw.
        with w.loop(there) as lane:
            place = 0
            for name, size in self.drawn.items():
                row = arrays[name] + (first + lane) * size
                for i in range(size):
                    row[i] = (places["drawn"] + place * lanes)[lane]
                    place += 1
