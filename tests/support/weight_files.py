"""What the tests of weights share: lines of a manifest, files that fit them, and no other place to search."""

import hashlib

from mkpc_kaggle.weights import WeightFile

DATA = b"these are the weights"
OTHER = b"those were the weights"[:21]


def digest_of(data):
    return "sha256:" + hashlib.sha256(data).hexdigest()


def line(name="a.bin", data=DATA, *, size=None, digest=None, slot="slot", source="somewhere"):
    return WeightFile(name, len(data) if size is None else size, digest or digest_of(data), "MIT", slot, source)


def put(directory, name="a.bin", data=DATA):
    directory.mkdir(parents=True, exist_ok=True)
    (directory / name).write_bytes(data)
    return directory
