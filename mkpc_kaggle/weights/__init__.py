"""Weight files: the manifest; finding, verifying, loading, fetching, converting.

The import brings no torch.
"""

from mkpc_kaggle.weights.checkpoint import load_into, load_tensors
from mkpc_kaggle.weights.manifest import UNVERIFIED, WeightFile
from mkpc_kaggle.weights.store import FileState, FoundFile, MissingWeights, WeightStore

__all__ = [
    "UNVERIFIED",
    "FileState",
    "FoundFile",
    "MissingWeights",
    "WeightFile",
    "WeightStore",
    "load_into",
    "load_tensors",
]
