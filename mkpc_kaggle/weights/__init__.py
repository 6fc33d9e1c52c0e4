"""Weight files: the manifest, and finding, verifying, loading, downloading and converting the files.

Importing this package imports no torch.
"""

from mkpc_kaggle.weights.checkpoint import load_into, load_tensors
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile
from mkpc_kaggle.weights.store import FoundFile, State, WeightStore

__all__ = ["UNVERIFIED", "FoundFile", "State", "WeightFile", "WeightStore", "load_into", "load_tensors"]
