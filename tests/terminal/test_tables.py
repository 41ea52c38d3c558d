"""Tables for the terminal."""

from jetbot_mjx.terminal import text_table


def test_columns_are_as_wide_as_their_longest_cell():
    rows = [("run", "steps", "success"), ("a", "1,000", "0.5"), ("longer", "2", "")]
    assert text_table(rows).splitlines() == [
        "run     steps  success",
        "a       1,000      0.5",
        "longer      2",
    ]


def test_columns_on_the_left_are_aligned_to_the_left():
    assert text_table([("a", "bb", "c"), ("aa", "b", "cc")], left=2) == "a   bb   c\naa  b   cc"


def test_no_cell_can_command_the_terminal():
    assert text_table([("\x1b[2J", "x")]) == r"\x1b[2J  x"
