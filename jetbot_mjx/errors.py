"""The one exception that means: the user can mend this, and one line says how."""


class UserError(Exception):
    """A mistake that the user can mend; its message is one line, shown without a traceback."""

    def __init__(self, message: str) -> None:
        """Keeps to one line what quotes a key, a path or another library's message."""
        super().__init__(" ".join(message.splitlines()))


def ran_out(error: Exception) -> bool:
    """Whether JAX failed because a device's memory did not suffice."""
    return "RESOURCE_EXHAUSTED" in str(error)
