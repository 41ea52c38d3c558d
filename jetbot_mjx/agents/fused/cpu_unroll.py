"""Write the kernel of an unroll on CPUs: all actions and steps of all environments.

Few environments at a time go through all steps. Their states stay in the cache, the weights are
arranged once, and no thread waits for another, while a call for each step would wake all threads
twice.
"""

from jetbot_mjx.agents.fused.arrays import UNROLL
from jetbot_mjx.agents.fused.cpu_actions import ActionStage
from jetbot_mjx.agents.fused.cpu_network import TILE_ROWS
from jetbot_mjx.agents.fused.cpu_stages import Stages
from jetbot_mjx.agents.fused.shapes import Minibatch, Unroll
from onekernel.build import LlvmWriter, Value, cpu


def unroll_stages(unroll: Unroll, batch: Minibatch, lanes: int) -> Stages:
    """Return the stage of `arrays.UNROLL`.

    Args:
      unroll: the networks and the environment.
      batch: the data, of which the number of environments and the time are used.
      lanes: the number of float32 values in a vector register.
    """
    return Stages([_UnrollStage(unroll, batch, lanes)])


class _UnrollStage(ActionStage):
    """Takes environments through all steps of an unroll."""

    name = "unroll"
    arrays_of = (*UNROLL.arguments, *UNROLL.returns)

    def __init__(self, unroll: Unroll, batch: Minibatch, lanes: int) -> None:
        # The parts are smaller than those of one step: each arranges the weights for all steps.
        super().__init__(unroll.shape, batch.environments, lanes, TILE_ROWS)
        self._unroll, self._time = unroll, batch.time
        numbers = {"kept": len(unroll.kept), "unroll_noise": self.shape.actions, **self.drawn}
        self._step_sizes = {name: batch.environments * size for name, size in numbers.items()}
        """The numbers of a step in each array that holds all steps."""

    def own_functions(self) -> list[LlvmWriter]:
        """Write the activation, the sample and the step of the environments."""
        return [
            *super().own_functions(),
            *cpu.step_functions(self._unroll.kernel, self.lanes),
        ]

    def tile(self, first: Value, count: Value) -> None:
        """Take some environments through all steps."""
        w, unroll, end = self.w, self._unroll, self.arrays["end"]
        limit = first + count
        with w.loop(self._time) as step:
            # Find the step's part of each array, and the states before it.
            sizes = self._step_sizes.items()
            here = {name: self.arrays[name] + step * size for name, size in sizes}
            before = w.select(step.equals(0), self.arrays["start"], end)
            here["observations"] = before + unroll.observation
            here["action_noise"] = here["unroll_noise"]
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
