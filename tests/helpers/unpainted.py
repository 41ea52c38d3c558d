"""Reports whose figures are composed but not painted, which is most of a report's time.

For tests of all that stands beside the figures.
"""

import contextlib
import io
from unittest import mock

from PIL import Image

from jetbot_mjx.evaluation import plots


@contextlib.contextmanager
def unpainted():
    """A context within which every figure of a report is one white pixel."""
    blank = io.BytesIO()
    Image.new("RGB", (1, 1), "white").save(blank, "png")
    with mock.patch.object(plots, "to_png", return_value=blank.getvalue()):
        yield
