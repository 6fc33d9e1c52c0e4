"""Points, boxes, clusters, two-view geometry and scores: numpy, OpenCV and SciPy only, no torch."""
