"""The folders that a Kaggle user uploads: a dataset with wheels and weights, a kernel with the notebook."""

from mkpc_kaggle.package.files import Item
from mkpc_kaggle.package.package import Package, Request, find_checkout, make_package

__all__ = ["Item", "Package", "Request", "find_checkout", "make_package"]
