"""Reconstruction of a folder of images: choice of pairs, cameras, output files."""
