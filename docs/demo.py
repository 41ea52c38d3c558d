"""Write pages of the policies that come with the package into the site: an MkDocs hook.

`demo/index.html` is that of the egocentric policy.
"""

import tempfile
from pathlib import Path
from typing import Any

from jetbot_mjx.deployment import write_web_page

PAGES = {
    "index": "jetbot_egocentric",
    "real": "real_jetbot",
    "camera": "jetbot_camera",
}
"""Policies by the name of the page."""


def on_files(files: Any, *, config: Any) -> Any:
    """Add the pages to the files of the site; MkDocs calls this."""
    from mkdocs.structure.files import File

    with tempfile.TemporaryDirectory() as folder:
        for name, policy in PAGES.items():
            page = write_web_page(f"pretrained:{policy}", Path(folder, f"{name}.html"))
            text = page.path.read_text("utf-8")
            files.append(File.generated(config, f"demo/{name}.html", content=text))
    return files
