"""One file for each matcher; the registry finds it by its name."""
