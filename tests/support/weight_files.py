"""Helpers of the tests of weights: entries of a manifest, and files that fit them."""

import hashlib
from pathlib import Path

from mkpc_kaggle.weights import WeightFile

DATA = b"these are the weights"
OTHER = b"those were the weights"


def digest_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def line(
    name: str = "a.pt", data: bytes = DATA, *, slot: str = "slot", **more: str
) -> WeightFile:
    return WeightFile(
        slot,
        **{"licence": "MIT", "size": len(data), "sha256": digest_of(data)} | more,
        name=name,
    )


def put(directory: Path, name: str = "a.pt", data: bytes = DATA) -> Path:
    directory.mkdir(parents=True, exist_ok=True)
    (directory / name).write_bytes(data)
    return directory
