"""Define the errors of invalid configurations."""

from jetbot_mjx.errors import InvalidError, NotFoundError


class ConfigError(InvalidError):
    """Raised when a configuration is invalid; states the key, the value and the remedy."""


class ConfigNotFoundError(ConfigError, NotFoundError):
    """Raised when there is no such file; callers may also catch a `FileNotFoundError`."""
