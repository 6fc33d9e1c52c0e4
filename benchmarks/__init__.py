"""Commands that measure; each prints its table. README.md lists them."""
