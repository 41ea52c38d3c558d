"""Format measured values for tables and plots."""

from collections.abc import Sequence


def format_spread(median: float, repeats: Sequence[float]) -> str:
    """Return the slowest and the fastest repeat relative to the median, as in `-1.2% .. +0.7%`."""
    return f"{min(repeats) / median - 1:+.1%} .. {max(repeats) / median - 1:+.1%}"


def format_count(count: float, digits: int = 6) -> str:
    """Return a number with a unit prefix, as in `1.08 G`.

    Args:
      count: The number.
      digits: The significant digits; trailing zeros are left out.
    """
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if count >= size:
            return f"{count / size:.{digits}g} {letter}"
    return f"{count:.{digits}g}"
