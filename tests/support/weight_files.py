"""Helpers of the tests of weights: lines of a manifest, and files that fit them."""

import hashlib
from pathlib import Path

from mkpc_kaggle.weights import WeightFile

DATA = b"these are the weights"
OTHER = b"those were the weights"[:21]  # of the same size: only a digest differs


def digest_of(data: bytes) -> str:
    return "sha256:" + hashlib.sha256(data).hexdigest()


def line(
    name: str = "a.bin",
    data: bytes = DATA,
    *,
    size: int | None = None,
    digest: str | None = None,
    slot: str = "slot",
    source: str = "somewhere",
) -> WeightFile:
    return WeightFile(
        name, len(data) if size is None else size, digest or digest_of(data), "MIT", slot, source
    )


def put(directory: Path, name: str = "a.bin", data: bytes = DATA) -> Path:
    directory.mkdir(parents=True, exist_ok=True)
    (directory / name).write_bytes(data)
    return directory
