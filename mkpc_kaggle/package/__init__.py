"""What a Kaggle user uploads: a dataset folder with wheels and weights, and a kernel folder with the notebook."""

from mkpc_kaggle.package.folder import Item
from mkpc_kaggle.package.package import Package, Request, find_checkout, make_package

__all__ = ["Item", "Package", "Request", "find_checkout", "make_package"]
