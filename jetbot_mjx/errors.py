"""Define exceptions for errors that the user can correct, each with a message of one line.

Names of files and values that come from files are shown by the functions of this module, so that a
message stays short and a terminal shows every character instead of obeying it.
"""

import contextlib
import errno
import math
import numbers
import os
import reprlib
from collections.abc import Iterator
from typing import TextIO

_LONGEST_LINE = 2000
"""Most characters of a message, which may quote names and values from a file."""


class UserError(Exception):
    """Raised when the user can correct the error; its one-line message needs no traceback."""

    def __init__(self, message: str) -> None:
        """Join the lines of a message that quotes a key, a path or another library's message."""
        line = printable(" ".join(message.splitlines()))
        super().__init__(clipped(line, _LONGEST_LINE))


class InvalidError(UserError, ValueError):
    """Raised when a value is wrong, so that callers may also catch a `ValueError`."""


class NotFoundError(UserError, FileNotFoundError):
    """Raised when a file or folder is missing; callers may also catch a `FileNotFoundError`."""


class MissingPackageError(UserError, ImportError):
    """Raised when an optional package is missing; callers may also catch an `ImportError`."""


def check_count(name: str, value: object, most: float = math.inf) -> None:
    """Check that an argument is a whole number from 1 to `most`.

    Raises:
      InvalidError: It is not; the message begins with `name`.
    """
    if not isinstance(value, numbers.Integral) or isinstance(value, bool) or value < 1:
        raise InvalidError(f"{name} = {value!r} is wrong: it should be a whole number from 1 on")
    if int(value) > most:
        raise InvalidError(f"{name} = {value} is wrong: it should be at most {most}")


def check_path(name: str, value: object) -> None:
    """Check that an argument is a text or a path, not empty, of characters that a name may have.

    Raises:
      InvalidError: It is not; the message begins with `name`.
    """
    text = os.fspath(value) if isinstance(value, os.PathLike) else value
    if not isinstance(text, str) or not text or "\0" in text:
        hint = ": give its run_dir" if hasattr(value, "run_dir") else ""
        raise InvalidError(f"{name} = {shown(value)} is wrong: it should be a path or a name{hint}")


def check_size(size: tuple[int, int]) -> None:
    """Check that the width and height of a video can be encoded [pixels].

    Raises:
      InvalidError: They are not even numbers from 64 to 4096.
    """
    sides = size if isinstance(size, list | tuple) else (size,)
    whole = all(isinstance(side, numbers.Integral) for side in sides)
    if len(sides) != 2 or not whole or any(x % 2 or not 64 <= x <= 4096 for x in sides):
        told = "x".join(map(str, sides))
        raise InvalidError(
            f"size = {told} is wrong: it should be two even numbers from 64 to 4096, as in 1280x720"
        )


@contextlib.contextmanager
def os_errors(message: str, kind: type[UserError] = UserError) -> Iterator[None]:
    """Convert an `OSError` inside the context to a one-line error.

    Args:
      message: the beginning of the line; the system's reason follows it.
      kind: the class of the error.

    Raises:
      UserError: an `OSError` was raised.
    """
    try:
        yield
    except UserError:
        # Some of them are `OSError`s too.
        raise
    except OSError as error:
        raise kind(f"{message}: {error.strerror or error}") from None


@contextlib.contextmanager
def requires_extra(extra: str, what: str) -> Iterator[None]:
    """Replace a failing import by one line that says how to install the package.

    Args:
      extra: the extra of this project that installs what the block imports.
      what: what needs the package, for the message.

    Raises:
      MissingPackageError: a package is not installed.
    """
    try:
        yield
    except ImportError as error:
        raise MissingPackageError(
            f"{what} needs {error.name}, which is not installed: pip install"
            f" 'jetbot_mjx[{extra}]', from a checkout '.[{extra}]'"
        ) from None


def printable(text: str) -> str:
    """Return one line in which characters that a terminal would obey are written as escapes."""
    if text.isprintable():
        return text
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape").decode() for one in text
    )


def printable_lines(text: str) -> str:
    """Return text of several lines, each of them made `printable`."""
    return "\n".join(map(printable, text.split("\n")))


def clipped(text: str, most: int = 300) -> str:
    """Return text whose middle is left out if it is too long.

    Args:
      text: the text.
      most: the number of characters of a text that is returned as it is.
    """
    return text if len(text) <= most else f"{text[: most // 2]} ... {text[-most // 2 :]}"


def shown(value: object) -> str:
    """Return a value as Python writes it, in a few hundred characters however large it is.

    Of a collection only the first items are read, because YAML's aliases let a small file stand for
    a collection with more items than fit into memory.
    """
    return clipped(_SHORT.repr(value))


class _ShortRepr(reprlib.Repr):
    """A `_ShortRepr` writes the first items of collections, and the size of long numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 3
        self.maxdict = self.maxlist = self.maxtuple = self.maxset = 8
        self.maxstring = self.maxother = 200

    def repr_int(self, x: int, level: int) -> str:
        # Python refuses to write integers of more than 4,300 digits.
        digits = int(x.bit_length() * _DECIMAL_DIGITS_PER_BIT) + 1
        return repr(x) if digits < _MOST_DIGITS else f"(a number of {digits:,} digits)"


_DECIMAL_DIGITS_PER_BIT = 0.30103
_MOST_DIGITS = 100
_SHORT = _ShortRepr()


def ran_out(error: Exception) -> bool:
    """Return whether JAX failed because a device ran out of memory."""
    return "RESOURCE_EXHAUSTED" in str(error)


_LOST = (
    *("CUDA_ERROR_", "DATA_LOSS:", "UNAVAILABLE:", "failed to synchronize", "device is lost"),
    *("Gloo ", "NCCL operation", "ncclRemoteError"),
)
"""What JAX's error says if a device or another process of the training failed, not the program."""


def lost_device(error: BaseException) -> str:
    """Return the reason if JAX failed because a device failed; nothing if it did not."""
    text = str(error)
    if ran_out(Exception(text)) or not any(one in text for one in _LOST):
        return ""
    return clipped(next(iter(text.splitlines())), 200)


NO_ANSWER = {
    *(errno.EIO, errno.ESTALE, errno.ETIMEDOUT, errno.EINTR, errno.ENOTCONN, errno.ECONNRESET),
    *(errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENETDOWN, errno.ENETUNREACH),
}
"""Errors by which a drive, such as one on a network, says nothing of the file asked for."""


class UnreadableError(UserError):
    """Raised when a drive does not answer, so that nobody knows what it holds."""


def check_answer(number: int | None, what: object) -> None:
    """Raise an `UnreadableError` if an error of the system says that a drive did not answer.

    Args:
      number: the number of the error.
      what: the file or the checkpoint that was to be read.
    """
    if number in NO_ANSWER:
        raise UnreadableError(
            f"{what} cannot be read now: {os.strerror(number)}: it may be intact: give the same"
            " command again when the drive answers"
        ) from None


def unanswered(error: OSError) -> str:
    """Return the file for which a drive did not answer, and why; nothing for other errors."""
    # Sockets have the same errors, but most of them not these, and name no file.
    if error.errno not in NO_ANSWER or not (error.filename or error.errno in _OF_FILES):
        return ""
    return f"{error.filename or 'a file'}: {error.strerror}"


_OF_FILES = {errno.EIO, errno.ESTALE}

READER_LEFT = {errno.EPIPE, errno.EIO, errno.ECONNRESET}
"""Errors of a pipe, a terminal or a socket whose other end was closed."""


def write_error(stream: TextIO | None) -> OSError | None:
    """Return the last error of a stream that keeps it instead of raising it; None if there is none.

    A command protects its standard output and standard error so.
    """
    raw = getattr(getattr(stream, "buffer", None), "raw", None)
    return getattr(raw, "error", None)
