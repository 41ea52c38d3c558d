"""Define exceptions for errors that the user can correct, each with a message of one line."""

import contextlib
import math
import numbers
from collections.abc import Iterator


class UserError(Exception):
    """Raised when the user can correct the error; its one-line message needs no traceback."""

    def __init__(self, message: str) -> None:
        """Join the lines of a message that quotes a key, a path or another library's message."""
        super().__init__(" ".join(message.splitlines()))


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


def ran_out(error: Exception) -> bool:
    """Return whether JAX failed because a device ran out of memory."""
    return "RESOURCE_EXHAUSTED" in str(error)
