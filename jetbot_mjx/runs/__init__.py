"""Read and write what a run folder holds: configuration, metrics, checkpoints, NaN dumps."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
