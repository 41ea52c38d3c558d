"""Show in a terminal what takes long and what was found: progress, tables, the process's time."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
