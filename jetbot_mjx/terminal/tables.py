"""Align rows of cells as a table for the terminal."""

from collections.abc import Sequence

from jetbot_mjx.errors import printable


def text_table(rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Return rows of cells as lines in which every column has the width of its longest cell.

    Args:
      rows: the rows, all with the same number of cells; usually the first holds the names of the
        columns. Characters that a terminal would obey are written as escapes.
      left: number of columns, from the first on, that are aligned to the left; the others are
        aligned to the right.
    """
    rows = [[printable(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if column < left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )
