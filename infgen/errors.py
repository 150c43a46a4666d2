"""Errors that name what the user gave, what was expected, and the way out."""


class ConfigError(ValueError):
    """A setting, word or path that does not exist or cannot have that value."""


class MissingExtraError(ValueError):
    """A package that comes with an extra is not installed."""
