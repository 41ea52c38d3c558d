"""Describe exceptions of a user's code in one line."""

import traceback
from collections.abc import Sequence
from pathlib import Path

PACKAGE = Path(__file__).parents[2]
"""Folder of this package."""

_REMEDIES = {
    "TracerBool": "Python cannot decide on an array: use jnp.where, & and | and ~",
    "TracerArray": "NumPy cannot take what JAX traces: use jax.numpy",
    "TracerInteger": "Python cannot index by an array: use jnp.take",
    "Concretization": "Python needs a number where there is an array: stay within jax.numpy",
    "UnexpectedTracer": "a value of another call was kept in self: methods must be pure",
}
"""Advice by the first letters of the name of JAX's exception."""


def describe_error(error: Exception, who: str, folders: Sequence[Path]) -> str:
    """Describe an exception in one line, with the advice for it if there is one.

    Args:
      error: the exception.
      who: the name of the method or class that raised it.
      folders: the last line of the traceback in one of these folders is reported; if empty, the
        last line in any file of the user.
    """
    # Choose the message.
    kind = type(error).__name__
    remedy = next((text for name, text in _REMEDIES.items() if kind.startswith(name)), None)
    what = remedy or next(iter(str(error).strip().splitlines()), "")
    # Find the line of code.
    places = [
        (Path(frame.filename), frame.lineno) for frame in traceback.extract_tb(error.__traceback__)
    ]
    if isinstance(error, SyntaxError) and error.filename:
        places.append((Path(error.filename), error.lineno))
        what = error.msg
    places = [
        (file, line)
        for file, line in places
        if (file.parent in folders if folders else PACKAGE not in file.parents)
        and "site-packages" not in file.parts
        and not str(file).startswith("<")
    ]
    where = f" ({places[-1][0].name}:{places[-1][1]})" if places else ""
    return " ".join(f"{who} raises {kind}{': ' * bool(what)}{what}{where}".split())
