"""Raise errors about kernels. Callers turn them into their own words."""

from typing import Literal

Kind = Literal["dtype", "platform", "derivative", "operation", "check"]


class KernelError(Exception):
    """Raised when a kernel cannot do what is asked of it."""

    def __init__(self, message: str, kind: Kind) -> None:
        """Set the message and the kind.

        Args:
          message: what is wrong, in one line.
          kind: `dtype`: an argument is not float32. `platform`: another back end must run the
            kernel. `derivative`: the kernel is differentiated. `operation`: the function cannot be
            lowered. `check`: its results are not those of XLA.
        """
        super().__init__(message)
        self.kind: Kind = kind


class UnsupportedError(KernelError):
    """Raised when an operation cannot be lowered; its message says which."""

    place: str | None = None
    """The user's line that made the operation, if it is known."""

    def __init__(self, message: str) -> None:
        """Set the message."""
        super().__init__(message, "operation")

    def __str__(self) -> str:
        """Return the operation and its place."""
        return super().__str__() + (f" ({self.place})" if self.place else "")
