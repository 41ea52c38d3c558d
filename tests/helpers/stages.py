"""Note the stages of which a command would show the progress."""

import contextlib
from collections.abc import Iterator

from jetbot_mjx.terminal import progress


@contextlib.contextmanager
def noted_stages() -> Iterator[list[str]]:
    """Yield a list of the names of the stages that begin inside the context."""
    names = []

    @contextlib.contextmanager
    def note(name, total):
        names.append(name)
        yield lambda count: None

    token = progress._DISPLAY.set(note)
    try:
        yield names
    finally:
        progress._DISPLAY.reset(token)
