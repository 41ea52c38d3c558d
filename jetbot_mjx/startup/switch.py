"""Turn all tricks of a command's start off."""

import os

from jetbot_mjx.errors import InvalidError

PLAIN_START = "JETBOT_MJX_PLAIN_START"
"""Environment variable that turns all tricks off if it is 1."""


def is_plain() -> bool:
    """Return whether a command should start without the tricks of this package.

    Raises:
      InvalidError: the environment variable is neither 0 nor 1.
    """
    value = os.environ.get(PLAIN_START) or "0"
    if value not in ("0", "1"):
        raise InvalidError(f"{PLAIN_START} = {value!r} is neither 0 nor 1")
    return value == "1"
