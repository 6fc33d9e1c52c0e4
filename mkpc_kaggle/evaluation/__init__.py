"""Runs held against known cameras."""
