"""Scores of runs against known cameras, and comparisons of scores."""
