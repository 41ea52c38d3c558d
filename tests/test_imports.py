"""What is left out of an import, and what is not."""

import sys
import types

import pytest

from jetbot_mjx.imports import standing_in


def test_inside_the_stand_in_is_found_and_afterwards_the_module_is_as_it_was():
    stand_in = types.ModuleType("not_there")
    with standing_in("not_there", stand_in):
        import colorsys  # any module that nobody has loaded yet

        import not_there
    assert not_there is stand_in
    assert "not_there" not in sys.modules
    assert sys.modules["colorsys"] is colorsys


def test_a_module_can_be_absent():
    with standing_in("wave", None), pytest.raises(ImportError):
        import wave  # noqa: F401


def test_a_module_that_is_loaded_stays():
    with standing_in("types", None):
        import types as found
    assert found is types


def test_an_error_inside_leaves_nothing_behind():
    with pytest.raises(ZeroDivisionError), standing_in("not_there", None):
        _ = 1 / 0
    assert "not_there" not in sys.modules
