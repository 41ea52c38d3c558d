"""Errors that the user can correct: one line each, short, with nothing that a terminal obeys."""

import errno
import io

import pytest

from jetbot_mjx.errors import (
    InvalidError,
    MissingPackageError,
    UserError,
    check_count,
    clipped,
    lost_device,
    printable,
    printable_lines,
    ran_out,
    requires_extra,
    shown,
    unanswered,
    write_error,
)


def test_a_message_of_several_lines_becomes_one():
    assert str(UserError("first\nsecond\r\nthird")) == "first second third"


def test_a_message_that_quotes_a_file_has_an_end():
    message = str(UserError("a" * 50_000 + "b"))
    assert len(message) < 2010
    assert message.endswith("ab")


def test_characters_that_a_terminal_obeys_are_written_out():
    assert str(UserError("a \x1b[31mred")) == r"a \x1b[31mred"
    assert printable("größer\t") == r"größer\t"
    assert printable_lines("a\x07\nb") == "a\\x07\nb"


def test_a_long_text_keeps_its_beginning_and_its_end():
    assert clipped("x" * 300) == "x" * 300
    short = clipped("a" * 500 + "b" * 500)
    assert short.startswith("a" * 150 + " ... ")
    assert short.endswith("b" * 150)


def test_a_large_value_is_shown_in_short():
    assert shown(10**400) == "(a number of 401 digits)"
    assert shown(10**90) == repr(10**90)
    assert len(shown(["x" * 1000] * 1000)) < 2000
    assert shown([[[[[1]]]]]) == "[[[[...]]]]"


@pytest.mark.parametrize("value", [0, -1, True, 1.0, "3", None])
def test_an_invalid_count_is_refused(value):
    with pytest.raises(InvalidError, match=r"^trials = .* is wrong: it should be a whole number"):
        check_count("trials", value)


def test_a_count_has_a_largest_value():
    check_count("trials", 1024, 1024)
    with pytest.raises(ValueError, match=r"^trials = 1025 is wrong: it should be at most 1024$"):
        check_count("trials", 1025, 1024)


def test_a_missing_package_is_named_with_the_command_that_installs_it():
    with (
        pytest.raises(MissingPackageError, match=r"^the search needs not_there, .*\[tune\]"),
        requires_extra("tune", "the search"),
    ):
        import not_there  # noqa: F401


def test_a_device_that_ran_out_of_memory_is_told_from_other_failures():
    assert ran_out(RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes"))
    assert not ran_out(RuntimeError("INVALID_ARGUMENT"))


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ("INTERNAL: CUDA_ERROR_ILLEGAL_ADDRESS: an error\nmore", "INTERNAL: CUDA_ERROR_ILLEGAL"),
        ("UNAVAILABLE: the device is gone", "UNAVAILABLE: the device is gone"),
        ("UNKNOWN: Gloo all-reduce failed: reset by peer", "UNKNOWN: Gloo all-reduce failed"),
        ("RESOURCE_EXHAUSTED: CUDA_ERROR_OUT_OF_MEMORY: failed to allocate", ""),
        ("INVALID_ARGUMENT: shapes differ", ""),
    ],
)
def test_a_device_that_failed_is_told_from_a_bug(message, reason):
    found = lost_device(RuntimeError(message))
    assert found.startswith(reason)
    assert bool(found) is bool(reason)
    assert "\n" not in found


def test_only_a_stream_that_keeps_its_error_has_one():
    class Kept(io.RawIOBase):
        error = OSError("full")

        def writable(self):
            return True

    assert write_error(io.TextIOWrapper(io.BufferedWriter(Kept()))) is Kept.error
    assert write_error(io.StringIO()) is None
    assert write_error(None) is None


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (OSError(errno.EIO, "Input/output error", "a/file"), "a/file: Input/output error"),
        (OSError(errno.EIO, "Input/output error"), "a file: Input/output error"),
        (TimeoutError(errno.ETIMEDOUT, "timed out", "a/file"), "a/file: timed out"),
        (TimeoutError(errno.ETIMEDOUT, "timed out"), ""),
        (FileNotFoundError(errno.ENOENT, "No such file", "a/file"), ""),
    ],
)
def test_a_drive_that_does_not_answer_is_told_from_a_mistake(error, told):
    assert unanswered(error) == told
