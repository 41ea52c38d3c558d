"""The interface between trainers and recorders: a trainer knows nothing of files."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jetbot_mjx.agents.networks import PolicyParams
from jetbot_mjx.agents.ppo import NanDump, TrainState


class Progress(NamedTuple):
    """The progress of the training of one seed."""

    env_steps: int
    """Environment steps so far."""
    params: PolicyParams
    """On the host."""
    metrics: Mapping[str, float]
    """Means and counts since the last complete report, by this project's names."""
    seconds: float
    """Time that training took since the last report, compilation apart where that is known."""
    state: TrainState | None = None
    """All that is needed to go on from here, on the host; None: the trainer cannot."""


class TrainerCallback:
    """A listener of a trainer; this one ignores everything."""

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        """Take the state of every seed at the end of an interval.

        Returns:
          Whether to go on.
        """
        del progress
        return True

    def on_preempt(self, progress: Sequence[Progress]) -> None:
        """Take the state of every seed where training was asked to stop between two reports."""

    def on_progress(self, env_steps: int, metrics: Mapping[str, float], seconds: float) -> None:
        """Take what is known between two reports: the mean of all seeds, and the time spent."""

    def on_nan_dump(self, seed_index: int, env_steps: int, nan_dump: NanDump) -> None:
        """Take a world that blew up before that many environment steps."""

    def on_compiled(self) -> None:
        """Hear that the training step is compiled."""
