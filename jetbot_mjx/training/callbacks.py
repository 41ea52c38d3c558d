"""What trainers and those who record them agree on: a trainer knows nothing of files."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jetbot_mjx.agents.networks import PolicyParams
from jetbot_mjx.agents.ppo import Fault, TrainState


class Progress(NamedTuple):
    """Where the training of one seed stands."""

    env_steps: int
    """Environment steps so far."""
    params: PolicyParams
    """On the host."""
    figures: Mapping[str, float]
    """Means and counts since the last complete report, by this project's names."""
    seconds: float
    """Time that training took since the last report, compilation apart where that is known."""
    state: TrainState | None = None
    """All that is needed to go on from here, on the host; None: the trainer cannot."""


class Recorder:
    """Who listens to a trainer; this one lets everything pass."""

    def report(self, progress: Sequence[Progress]) -> bool:
        """Takes the state of every seed at the end of an interval.

        Returns:
          Whether to go on.
        """
        del progress
        return True

    def pause(self, progress: Sequence[Progress]) -> None:
        """Takes the state of every seed where training was asked to stop between two reports."""

    def tell(self, env_steps: int, figures: Mapping[str, float], seconds: float) -> None:
        """Takes what is known between two reports: the mean of all seeds, and the time spent."""

    def keep_fault(self, seed_index: int, env_steps: int, fault: Fault) -> None:
        """Takes a world that blew up before that many environment steps."""

    def compiled(self) -> None:
        """Hears that the training step is compiled."""
