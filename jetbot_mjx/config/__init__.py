"""Define, read and check the configuration of a run: a file for each section of its YAML.

A YAML file contains only the settings that differ from the defaults in the sections. Every key,
type and bound is checked before anything else happens, and an error is reported in one line. A
configuration is immutable, and a run stores it with all defaults filled in. Nothing here imports
JAX.

Pydantic checks strict types, bounds and unknown keys, and provides a schema from which the
reference can be generated.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
