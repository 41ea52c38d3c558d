"""Python with the packages that are named, and no others."""

import subprocess
import sys
from pathlib import Path

import numpy as np


def site_with(tmp_path, names):
    """A folder in which these packages of this environment can be imported, and no others."""
    site = tmp_path / "site"
    site.mkdir()
    home = Path(np.__file__).parents[1]
    for name in names:
        (site / name).symlink_to(home / name)
    return site


def alone(site, source):
    """Runs a program with the standard library and what a site holds."""
    program = (
        f"import sys; sys.dont_write_bytecode = True; sys.path.append({str(site)!r})\n{source}"
    )
    # Neither the environment's packages nor the user's, nor this checkout.
    return subprocess.run(
        [sys.executable, "-I", "-S", "-c", program], capture_output=True, text=True, cwd=site
    )


NUMPY = [path.name for path in Path(np.__file__).parents[1].glob("numpy*")]
