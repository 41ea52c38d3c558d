"""MJX, imported without the two lines that it prints when its optional Warp part is absent."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()):
    from mujoco.mjx import Data, Model, make_data, put_model, step

__all__ = ["Data", "Model", "make_data", "put_model", "step"]
