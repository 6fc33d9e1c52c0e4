"""The version: a leaf, so that any layer may say it."""

__version__ = "1.0.0"
