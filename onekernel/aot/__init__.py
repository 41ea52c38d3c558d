"""Cache compiled programs on disk, so that later processes need not trace them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
