"""Write the kernel that draws the actions of all environments on CPUs."""

import dataclasses
from collections.abc import Iterator, Mapping

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.cpu_network import (
    HEAD,
    MOST_PARTS,
    TILE_ROWS,
    Division,
    NetworkStage,
)
from jetbot_mjx.agents.fused.cpu_product import rounded_up
from jetbot_mjx.agents.fused.cpu_stages import Call, sample_function
from jetbot_mjx.agents.fused.sample_loss import vector_of
from jetbot_mjx.agents.fused.shapes import UpdateShape
from onekernel.build import LlvmWriter, Value, scalarize

_PART_ROWS = 2 * TILE_ROWS
"""Environments of a part if there are no more than `MOST_PARTS` times as many; each part copies the
weights."""


@dataclasses.dataclass(frozen=True)
class ActionDivision(Division):
    """An `ActionDivision` divides the environments."""

    shape: UpdateShape
    environments: int
    lanes: int
    is_policy: bool = True

    @property
    def items(self) -> int:
        """Return the number of environments."""
        return self.environments

    @property
    def part_items(self) -> int:
        """Return the number of environments of a part."""
        return max(_PART_ROWS, -(-self.environments // MOST_PARTS))

    @property
    def steps(self) -> int:
        """Return 1: an environment has one row."""
        return 1

    @property
    def reads(self) -> int:
        """Return how many numbers an action depends on."""
        return self.outputs + 2 * self.shape.actions

    def extra_sizes(self) -> dict[str, int]:
        """Return the floats of what the sample reads and writes."""
        lanes = self.lanes
        return {"sample": self.reads * lanes, "drawn": sum(self.shape.drawn) * lanes}


PARAMETERS = ("params", "mean", "scale")
"""The arrays of `launch.actions` that all environments share."""

DRAWN = ("action", "raw_action", "log_prob", "distribution_params")
"""The arrays of `launch.Actions`."""

_ARGUMENTS = (*PARAMETERS, "observations", "noise")


def action_call(division: ActionDivision) -> Call:
    """Return the call, which takes and returns the arrays of `launch.actions`.

    Args:
      division: the division of the environments.
    """
    shape = division.shape
    sizes = {"observations": shape.observations, "noise": shape.actions}
    sizes |= zip(DRAWN, shape.drawn, strict=True)
    sizes = {name: division.environments * size for name, size in sizes.items()}
    sizes |= {"params": shape.size, "mean": shape.observations, "scale": shape.observations}
    return Call(_ARGUMENTS, DRAWN, sizes, [ActionStage(division)])


class ActionStage(NetworkStage):
    """An `ActionStage` runs the policy network and draws an action from each distribution."""

    name = "actions"
    arrays_of = (*_ARGUMENTS, *DRAWN)

    def own_functions(self) -> list[LlvmWriter]:
        """Write the activation and the sample."""
        activate = self.activation()
        activated = scalarize(lambda z: activate(z)[0], vector_of())
        drawn = sample_loss.action_program(self.shape)
        return [
            self.on_layers("activate", activated, (0,), (0,)),
            sample_function("draw", drawn, self.division.lanes),
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
        deviations = self.params + (shape.hidden + (shape.width + 1) * self.division.outputs)
        # Collect what the samples read, environment by environment.
        with w.loop(lanes) as lane:
            # Lanes beyond the last environment repeat it.
            within = w.minimum(lane, there - 1)
            outputs = places["outputs"] + (start + within) * HEAD
            noise = (first + within) * actions
            sources = [
                (outputs, self.division.outputs),
                (deviations if shape.deviations else outputs, actions),
                (arrays["noise"] + noise, actions),
            ]
            target = places["sample"] + lane
            numbers = [(source, i) for source, count in sources for i in range(count)]
            for place, (source, i) in enumerate(numbers):
                target[place * lanes] = source[i]
        w.call("draw", places["sample"], places["drawn"])
        # Store what they draw.
        with w.loop(there) as lane:
            place = 0
            for name, size in zip(DRAWN, shape.drawn, strict=True):
                row = arrays[name] + (first + lane) * size
                for i in range(size):
                    row[i] = (places["drawn"] + place * lanes)[lane]
                    place += 1
