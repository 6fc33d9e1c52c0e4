"""Reconstruction of a batch: keypoints from all matches, pycolmap's models, and the F of each pair."""
