"""Input and output files: the competition directory, pair lists, images."""
