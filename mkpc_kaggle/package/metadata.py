"""The JSON files that the ``kaggle`` command reads (its docs/datasets_metadata.md and kernels_metadata.md)."""

import json
import re
from collections.abc import Iterable

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.version import __version__

COMPETITION = "image-matching-challenge-2022"
DATASET_SLUG = "mkpc-kaggle"
KERNEL_TITLE = "MKPC submission"
KERNEL_SLUG = KERNEL_TITLE.lower().replace(" ", "-")  # Kaggle derives the slug from the title; both must agree
LATEST, ORIGINAL = "latest", "original"


def check_owner(owner: str) -> None:
    """Raise :class:`UserError` unless ``owner`` can be a Kaggle user name."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9-]*", owner):
        raise UserError(
            f"--owner {owner!r} cannot be a Kaggle user name: give the last part of your profile's address, "
            "letters, digits and dashes"
        )


def dataset_metadata(owner: str, licences: Iterable[str]) -> str:
    """Return ``dataset-metadata.json``. Kaggle allows one licence per dataset; the description lists all."""
    return _json(
        {
            "id": f"{owner}/{DATASET_SLUG}",
            "title": f"MKPC Kaggle {__version__}",
            "subtitle": "Offline two-stage image matching: wheels and weights",
            "description": "mkpc_kaggle (Apache-2.0), the wheels that it needs (each has its licence inside), and "
            "weights of image matchers. weights_manifest.txt names the licence and the source of each file of "
            f"weights. Licences of the weights here: {', '.join(sorted(set(licences))) or 'none, no weights'}.",
            "licenses": [{"name": "other"}],
        }
    )


def kernel_metadata(owner: str, notebook: str, image: str) -> str:
    """Return ``kernel-metadata.json``: two T4 GPUs, internet off, the competition and our dataset attached.

    ``image`` is ``latest``, ``original`` (the image of the kernel's first version), or an image with the digest
    that ``kaggle kernels pull -m`` reports. Raises :class:`UserError` for other values.
    """
    if image not in (LATEST, ORIGINAL) and not re.fullmatch(r"[\w./:-]+@sha256:[0-9a-f]{64}", image):
        raise UserError(f"--image {image}: give {LATEST}, {ORIGINAL}, or an image as NAME@sha256:DIGEST")
    pinned = {"docker_image": image} if "@" in image else {}
    return _json(
        {
            "id": f"{owner}/{KERNEL_SLUG}",
            "title": KERNEL_TITLE,
            "code_file": notebook,
            "language": "python",
            "kernel_type": "notebook",
            "is_private": True,
            "enable_gpu": True,
            "machine_shape": "NvidiaTeslaT4",
            "docker_image_pinning_type": ORIGINAL if pinned else image,
            **pinned,
            "enable_internet": False,
            "competition_sources": [COMPETITION],
            "dataset_sources": [f"{owner}/{DATASET_SLUG}"],
            "kernel_sources": [],
            "model_sources": [],
        }
    )


def _json(table: dict[str, object]) -> str:
    return json.dumps(table, indent=2) + "\n"
