"""Folders of images in, cameras out: which pairs are matched, and the files that come of them."""
