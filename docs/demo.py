"""Write pages of policies that drive and learn into the site: an MkDocs hook.

`demo/index.html` is that of a policy that is trained here, within a quarter of a minute, so that
it can be seen untrained, early and at its end. The others are of policies that come with the
package.
"""

import functools
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from jetbot_mjx import train
from jetbot_mjx.deployment import write_web_page

TRAINED = "jetbot_egocentric"
"""The configuration of the first page."""

PAGES = {
    "index": TRAINED,
    "real": "pretrained:real_jetbot",
    "camera": "pretrained:jetbot_camera",
}
"""Runs by the name of the page."""


def on_files(files: Any, *, config: Any) -> Any:
    """Add the pages to the files of the site; MkDocs calls this."""
    from mkdocs.structure.files import File

    for name, text in page_texts().items():
        files.append(File.generated(config, f"demo/{name}.html", content=text))
    return files


@functools.cache
def page_texts() -> Mapping[str, str]:
    """Return the pages as HTML by their names, the same ones whenever the site is built again."""
    pages = {}
    with tempfile.TemporaryDirectory() as folder:
        # The first checkpoint is the early one.
        run = Path(folder, TRAINED)
        train(TRAINED, {"checkpoint_interval": 49_152}, run_dir=run)
        for name, source in PAGES.items():
            path = Path(folder, f"{name}.html")
            write_web_page(run if source == TRAINED else source, path)
            pages[name] = path.read_text("utf-8")
    return pages
