"""Figures, drawn with matplotlib, an optional dependency."""
