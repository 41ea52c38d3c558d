"""Take a policy out of JAX: exporters, a simulated JetBot, logs of real drives."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
