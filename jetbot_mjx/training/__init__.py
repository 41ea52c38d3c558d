"""Drive PPO from a configuration to a finished run: record it and survive interruptions."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
