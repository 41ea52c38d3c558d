"""Simulate one JetBot and its task as a `brax.envs.Env`: robot, task, physics and wrappers.

Everything is pure and unbatched: batch with `jax.vmap`, outermost.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
