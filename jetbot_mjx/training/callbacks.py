"""Define the callback interface of the trainers, which themselves write no files."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jetbot_mjx.agents import NanDump, PolicyParams, TrainState


class Progress(NamedTuple):
    """A `Progress` holds the state of one seed's training."""

    env_steps: int
    """Environment steps so far."""
    params: PolicyParams
    """The policy's parameters, on the host."""
    metrics: Mapping[str, float]
    """Means and counts since the last complete report, under this project's names."""
    seconds: float
    """Training time since the last report [s], without compilation where that is known."""
    state: TrainState | None = None
    """The complete training state, on the host; None if the trainer cannot resume."""


class TrainerCallback:
    """A `TrainerCallback` receives a trainer's events; this base class ignores them all."""

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        """Handle the end of an interval.

        Args:
          progress: the progress of every seed.

        Returns:
          Whether the training goes on.
        """
        return True

    def on_preempt(self, progress: Sequence[Progress]) -> None:
        """Handle a stop on request between two reports.

        Args:
          progress: the progress of every seed.
        """

    def on_progress(self, env_steps: int, metrics: Mapping[str, float], seconds: float) -> None:
        """Handle progress between two reports.

        Args:
          env_steps: environment steps so far.
          metrics: means over all seeds since the last report.
          seconds: training time since the last report [s].
        """

    def on_nan_dump(self, seed_index: int, env_steps: int, nan_dump: NanDump) -> None:
        """Handle a non-finite state.

        Args:
          seed_index: index of the seed.
          env_steps: environment steps at the end of the call in which it happened.
          nan_dump: the dump, with arrays on the host.
        """

    def on_compiled(self) -> None:
        """Handle the end of compilation: training begins."""
