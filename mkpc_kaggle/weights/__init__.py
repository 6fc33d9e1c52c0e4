"""Weight files: the manifest; finding, verifying, loading, fetching.

The import brings no torch.
"""

from mkpc_kaggle.weights.checkpoint import load_into, load_tensors
from mkpc_kaggle.weights.manifest import WeightFile
from mkpc_kaggle.weights.store import FoundFile, WeightStore

__all__ = ["FoundFile", "WeightFile", "WeightStore", "load_into", "load_tensors"]
