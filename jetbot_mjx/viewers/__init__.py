"""Show a policy: as a video, on a page in the browser, in MuJoCo's window."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
