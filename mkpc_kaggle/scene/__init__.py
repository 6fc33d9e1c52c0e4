"""Reconstruction of a batch: keypoints from all matches, models by pycolmap, and the choice of each
pair's F.
"""
