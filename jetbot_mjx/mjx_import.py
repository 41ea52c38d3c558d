"""Import MJX, and Brax's environments after it.

MJX prints two lines if its optional part Warp is absent, also where Brax imports it. Whatever of
this package needs either takes them from here, which drops these lines.
"""

import contextlib
import io
import sys

_printed = io.StringIO()
with contextlib.redirect_stdout(_printed):
    import mujoco.mjx  # noqa: F401
    from brax.envs import Env, Wrapper
sys.stdout.writelines(
    line
    for line in _printed.getvalue().splitlines(keepends=True)
    if not line.startswith(("Failed to import warp:", "Failed to import mujoco_warp:"))
)

__all__ = ["Env", "Wrapper"]
