"""Keep real time: compute when steps are due, and count events per second."""

import collections
import math

_CATCH_UP_SECONDS = 0.1  # longest delay that a clock makes up for; steps beyond it are dropped


class Clock:
    """A `Clock` computes how many periodic steps are due, without drift."""

    def __init__(self, period: float, now: float) -> None:
        """Start the clock; the first step is due one period from now.

        Args:
          period: the time between two steps [s].
          now: the present time [s].
        """
        self._period = period
        self._next = now + period

    def due(self, now: float) -> int:
        """Return the number of steps that are due, at most those of a tenth of a second.

        After a longer delay the clock continues from now, and the missed steps are dropped.

        Args:
          now: the present time [s].
        """
        steps = max(0, math.floor((now - self._next) / self._period) + 1)
        most = max(1, math.ceil(_CATCH_UP_SECONDS / self._period))
        self._next += steps * self._period
        return min(steps, most)

    def wait(self, now: float) -> float:
        """Return the time until the next step is due [s].

        Args:
          now: the present time [s].
        """
        return max(0.0, self._next - now)


class Rate:
    """A `Rate` counts the events within the last second."""

    def __init__(self) -> None:
        """Start without events."""
        self._times: collections.deque[float] = collections.deque()

    def count(self, now: float, events: int = 1) -> None:
        """Add events.

        Args:
          now: the time of the events [s].
          events: their number.
        """
        self._times.extend([now] * events)
        self.per_second(now)

    def per_second(self, now: float) -> float:
        """Return the number of events within the last second [1/s].

        Args:
          now: the present time [s].
        """
        while self._times and self._times[0] <= now - 1.0:
            self._times.popleft()
        return float(len(self._times))
