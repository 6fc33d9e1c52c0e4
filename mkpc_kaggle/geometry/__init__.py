"""Points, boxes, clusters, two-view geometry and scores; imports no torch."""
