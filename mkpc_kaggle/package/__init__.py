"""The folders that a Kaggle user uploads: a dataset with wheels and weights, a kernel with the
notebook.
"""
