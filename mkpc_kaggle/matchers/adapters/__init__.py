"""One file per matcher; the registry finds it by name."""
