"""Write the kernel of an unroll on CPUs: all actions and steps of all environments.

Few environments at a time go through all steps. Their states stay in the cache, the weights are
arranged once, and no thread waits for another, while a call for each step would wake all threads
twice.
"""

import dataclasses
from typing import NamedTuple

from jetbot_mjx.agents.fused.cpu_actions import DRAWN, PARAMETERS, ActionDivision, ActionStage
from jetbot_mjx.agents.fused.cpu_network import MOST_PARTS, TILE_ROWS
from jetbot_mjx.agents.fused.cpu_stages import Call
from jetbot_mjx.agents.fused.shapes import UpdateShape
from onekernel import Kernel
from onekernel.build import LlvmWriter, Value, cpu


class Unroll(NamedTuple):
    """An `Unroll` describes a step of an unroll."""

    shape: UpdateShape
    kernel: Kernel
    """The step of an environment, from the numbers of its state and an action to the next state."""
    observation: int
    """Where the observation begins among the numbers of a state."""
    kept: tuple[int, ...]
    """Places of the numbers that are kept of each state."""

    @property
    def state(self) -> int:
        """Return how many numbers a state has."""
        return self.kernel.argument_shapes[0][0]

    @property
    def ranges(self) -> list[tuple[int, int, int]]:
        """Return of each range of adjacent kept numbers its place among them, its first and last.

        The place is that among the kept ones.
        """
        ranges: list[tuple[int, int, int]] = []
        for place, number in enumerate(self.kept):
            if ranges and ranges[-1][2] == number - 1:
                ranges[-1] = (*ranges[-1][:2], number)
            else:
                ranges.append((place, number, number))
        return ranges


@dataclasses.dataclass(frozen=True)
class UnrollDivision(ActionDivision):
    """An `UnrollDivision` divides the environments of an unroll."""

    @property
    def part_items(self) -> int:
        """Return the number of environments of a part, which arranges the weights once."""
        return max(TILE_ROWS, -(-self.environments // MOST_PARTS))


def unroll_call(unroll: Unroll, environments: int, time: int, lanes: int) -> Call:
    """Return the call, which takes and returns the arrays of `launch.unroll`.

    Args:
      unroll: the networks and the environment.
      environments: the number of environments.
      time: the number of steps.
      lanes: the number of float32 values in a vector register.
    """
    shape, states = unroll.shape, environments * unroll.state
    stage = _UnrollStage(UnrollDivision(shape, environments, lanes), unroll, time)
    sizes = {name: time * size for name, size in stage.sizes.items()}
    sizes |= {"start": states, "end": states, "params": shape.size}
    sizes |= {"mean": shape.observations, "scale": shape.observations}
    return Call((*PARAMETERS, "start", "noise"), ("end", "kept", *DRAWN), sizes, [stage])


class _UnrollStage(ActionStage):
    """Takes environments through all steps of an unroll."""

    name = "unroll"
    arrays_of = (*PARAMETERS, "start", "noise", "end", "kept", *DRAWN)

    def __init__(self, division: UnrollDivision, unroll: Unroll, time: int) -> None:
        super().__init__(division)
        self._unroll, self._time = unroll, time

    @property
    def sizes(self) -> dict[str, int]:
        """Return how many numbers a step has in each array that holds all steps."""
        sizes = {"kept": len(self._unroll.kept), "noise": self.shape.actions}
        sizes |= zip(DRAWN, self.shape.drawn, strict=True)
        return {name: self.division.environments * size for name, size in sizes.items()}

    def own_functions(self) -> list[LlvmWriter]:
        """Write the activation, the sample and the step of the environments."""
        return [
            *super().own_functions(),
            *cpu.step_functions(self._unroll.kernel, self.division.lanes),
        ]

    def tile(self, first: Value, count: Value) -> None:
        """Take some environments through all steps."""
        w, unroll, end = self.w, self._unroll, self.arrays["end"]
        limit = first + count
        with w.loop(self._time) as step:
            # Find the step's part of each array, and the states before it.
            here = {name: self.arrays[name] + step * size for name, size in self.sizes.items()}
            before = w.select(step.equals(0), self.arrays["start"], end)
            here["observations"] = before + unroll.observation
            # Draw the actions, and step the environments.
            self.act(first, count, here, unroll.state)
            for start in self.groups(count):
                w.call("instances", before, here["action"], end, first + start, limit)
            # Copy what is kept of the states.
            with w.loop(count) as row:
                environment = first + row
                source = end + environment * unroll.state
                target = here["kept"] + environment * len(unroll.kept)
                for place, begin, last in unroll.ranges:
                    with w.loop(last + 1 - begin) as i:
                        (target + place)[i] = (source + begin)[i]
