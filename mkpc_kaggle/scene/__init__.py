"""A batch together: keypoints from all matches, reconstruction by pycolmap, and which F a pair gets."""
