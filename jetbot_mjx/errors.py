"""Define the exception for errors that the user can correct, with a message of one line."""


class UserError(Exception):
    """Raised when the user can correct the error; its one-line message needs no traceback."""

    def __init__(self, message: str) -> None:
        """Join the lines of a message that quotes a key, a path or another library's message."""
        super().__init__(" ".join(message.splitlines()))


def ran_out(error: Exception) -> bool:
    """Return whether JAX failed because a device ran out of memory."""
    return "RESOURCE_EXHAUSTED" in str(error)
