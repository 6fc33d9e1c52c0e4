"""Points, boxes, clusters, two-view geometry and scores. Uses NumPy, OpenCV, SciPy and
scikit-learn, not torch.
"""
