"""The folders that a Kaggle user uploads: a dataset of wheels and weights, and the notebook."""
