"""Real time: when the next step is due, and how often something happens."""

import collections
import math

_CATCH_UP_SECONDS = 0.1  # what a clock that was held up makes good; the rest is lost


class Clock:
    """Says how many control steps are due, at an even pace that does not drift."""

    def __init__(self, period: float, now: float) -> None:
        """Start.

        Args:
          period: from one step to the next [s].
          now: the first step is due a period later [s].
        """
        self._period = period
        self._next = now + period

    def due(self, now: float) -> int:
        """Return how many steps to take, at most what is due within a tenth of a second.

        A clock that was held up for longer goes on from here: what it missed is not made good.
        """
        steps = max(0, math.floor((now - self._next) / self._period) + 1)
        most = max(1, math.ceil(_CATCH_UP_SECONDS / self._period))
        self._next += steps * self._period
        return min(steps, most)

    def wait(self, now: float) -> float:
        """Return how long until the next step is due [s]."""
        return max(0.0, self._next - now)


class Rate:
    """A counter of events within the last second."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._times: collections.deque[float] = collections.deque()

    def count(self, now: float, events: int = 1) -> None:
        """Note events that happened just now [s]."""
        self._times.extend([now] * events)
        self.per_second(now)

    def per_second(self, now: float) -> float:
        """Return the number of events of the second up to now [1/s]."""
        while self._times and self._times[0] <= now - 1.0:
            self._times.popleft()
        return float(len(self._times))
