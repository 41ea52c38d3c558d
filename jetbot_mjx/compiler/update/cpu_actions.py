"""Write the kernel that draws the actions of all environments on CPUs."""

import dataclasses
import functools
from collections.abc import Iterator, Mapping

from jetbot_mjx.compiler.lower_jaxpr import scalarize
from jetbot_mjx.compiler.update import sample_loss
from jetbot_mjx.compiler.update.cpu_network import (
    HEAD,
    MOST_PARTS,
    TILE_ROWS,
    Division,
    NetworkStage,
)
from jetbot_mjx.compiler.update.cpu_stages import Call
from jetbot_mjx.compiler.update.sample_loss import ActionSample, vector_of
from jetbot_mjx.compiler.update.shapes import UpdateShape

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

    def functions(self) -> list[str]:
        """Return the activation and the sample."""
        scalar, actions = vector_of(), vector_of(self.shape.actions)
        activate = self.activation()
        activated = scalarize(lambda z: activate(z)[0], scalar)
        draw = functools.partial(
            sample_loss.action_sample, tanh=self.shape.distribution == "tanh_normal"
        )
        sample = ActionSample(vector_of(self.division.outputs), actions, actions)
        return [
            self.on_layers("activate", activated, ["%one"], ["%one"]),
            self.on_sample("draw", scalarize(draw, sample), self.division.lanes),
        ]

    def tile(self, first: str, count: str) -> None:
        """Draw the actions of some environments."""
        self.act(first, count, self.arrays, self.shape.observations)

    def act(self, first: str, count: str, arrays: Mapping[str, str], stride: int) -> None:
        """Draw the actions of some environments.

        Args:
          first: the first environment.
          count: their number.
          arrays: the addresses of the observations, the noise and the results of all environments.
          stride: numbers from one observation to the next.
        """
        code = self.code
        with code.loop(count) as row:
            place = code.mul(code.add(first, row), stride)
            self.load_observation(code.at(arrays["observations"], place), row)
        self.forward(self.stored_rows(count))
        for start in self.groups(count):
            there = code.smaller(code.sub(count, start), code.lanes)
            self._draw(code.add(first, start), start, there, arrays)

    def groups(self, count: str) -> Iterator[str]:
        """Repeat what is appended for as many environments at once as a vector has lanes.

        Args:
          count: the number of environments.

        Yields:
          The first one of the group.
        """
        code = self.code
        groups = code.let(f"udiv i64 {code.add(count, code.lanes - 1)}, {code.lanes}")
        with code.loop(groups) as group:
            yield code.mul(group, code.lanes)

    def _draw(self, first: str, start: str, there: str, arrays: Mapping[str, str]) -> None:
        """Draw the actions of a group of environments.

        Args:
          first: the first environment.
          start: its row.
          there: the number of environments.
          arrays: those of `act`.
        """
        code, shape, places = self.code, self.shape, self.places
        lanes, actions = code.lanes, shape.actions
        deviations = code.at(self.params, shape.hidden + (shape.width + 1) * self.division.outputs)
        with code.loop(lanes) as lane:
            # Lanes beyond the last environment repeat it.
            within = code.smaller(lane, code.sub(there, 1))
            outputs = code.at(places["outputs"], code.mul(code.add(start, within), HEAD))
            noise = code.mul(code.add(first, within), actions)
            sources = [
                (outputs, self.division.outputs),
                (deviations if shape.deviations else outputs, actions),
                (code.at(arrays["noise"], noise), actions),
            ]
            target = code.at(places["sample"], lane)
            numbers = [(source, i) for source, count in sources for i in range(count)]
            for place, (source, i) in enumerate(numbers):
                code.copy(code.at(source, i), code.at(target, place * lanes))
        code.call("draw", f"ptr {places['sample']}", f"ptr {places['drawn']}")
        with code.loop(there) as lane:
            place = 0
            for name, size in zip(DRAWN, shape.drawn, strict=True):
                row = code.mul(code.add(first, lane), size)
                for i in range(size):
                    source = code.at(places["drawn"], place * lanes, lane)
                    code.copy(source, code.at(arrays[name], row, i))
                    place += 1
