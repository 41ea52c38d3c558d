"""Define exceptions for errors that the user can correct, each with a message of one line."""


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


def ran_out(error: Exception) -> bool:
    """Return whether JAX failed because a device ran out of memory."""
    return "RESOURCE_EXHAUSTED" in str(error)
