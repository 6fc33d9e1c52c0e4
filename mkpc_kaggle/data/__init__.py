"""Files in and out: the competition directory, lists of pairs, images."""
