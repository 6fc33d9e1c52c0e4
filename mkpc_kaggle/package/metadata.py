"""The JSON files that the ``kaggle`` command reads, and the dataset's page.

Their format: docs/datasets_metadata.md and docs/kernels_metadata.md of the command.
"""

import json
import re
from collections.abc import Iterable, Sequence

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.version import __version__

COMPETITION = "image-matching-challenge-2022"
DATASET_METADATA = "dataset-metadata.json"
DATASET_SLUG = "mkpc-kaggle"
KERNEL_TITLE = "MKPC submission"
# Kaggle derives the slug from the title; both must agree.
KERNEL_SLUG = KERNEL_TITLE.lower().replace(" ", "-")
# Values of ``docker_image_pinning_type``.
LATEST = "latest"
ORIGINAL = "original"
# ALIKED-n16 and its LightGlue on Kaggle Models: the store finds the files below /kaggle/input by
# their digests.
KAGGLE_MODELS = ("oldufo/aliked/pyTorch/aliked-n16/1", "oldufo/lightglue/pyTorch/aliked/1")


def check_owner(owner: str) -> None:
    """Raise :class:`UserError` unless ``owner`` can be a Kaggle user name."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9-]*", owner):
        raise UserError(
            f"--owner {owner!r} cannot be a Kaggle user name: give the last part of your profile's address, "
            "letters, digits and dashes"
        )


def dataset_metadata(owner: str, licences: Iterable[str]) -> str:
    """Return ``dataset-metadata.json``.

    Kaggle allows one licence per dataset; the description lists all.
    """
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


def kernel_metadata(
    owner: str, notebook: str, image: str, *, has_gpu: bool = True, models: Sequence[str] = ()
) -> str:
    """Return ``kernel-metadata.json``: the competition, our dataset and ``models`` are attached.

    The internet is off. With ``has_gpu``, the notebook asks for two T4 GPUs. Without weights they
    would idle and use up the quota.

    ``image`` is ``latest``, ``original`` (the image of the kernel's first version), or an image
    with the digest that ``kaggle kernels pull -m`` reports. Raises :class:`UserError` for other
    values.
    """
    is_pinned = re.fullmatch(r"[\w./:-]+@sha256:[0-9a-f]{64}", image) is not None
    if image not in (LATEST, ORIGINAL) and not is_pinned:
        raise UserError(
            f"--image {image}: give {LATEST}, {ORIGINAL}, or an image as NAME@sha256:DIGEST"
        )
    machine = {"machine_shape": "NvidiaTeslaT4"} if has_gpu else {}
    pinned = {"docker_image": image} if is_pinned else {}
    return _json(
        {
            "id": f"{owner}/{KERNEL_SLUG}",
            "title": KERNEL_TITLE,
            "code_file": notebook,
            "language": "python",
            "kernel_type": "notebook",
            "is_private": True,
            "enable_gpu": has_gpu,
            **machine,
            "docker_image_pinning_type": ORIGINAL if is_pinned else image,
            **pinned,
            # The rules of the competition.
            "enable_internet": False,
            "competition_sources": [COMPETITION],
            "dataset_sources": [f"{owner}/{DATASET_SLUG}"],
            "kernel_sources": [],
            "model_sources": list(models),
        }
    )


def dataset_page(licences: Iterable[str]) -> str:
    """Return the dataset's ``README.md``.

    The project's own has pictures and links that Kaggle cannot show.
    """
    named = ", ".join(sorted(set(licences))) or "none, this dataset has no weights"
    return f"""\
# MKPC Kaggle {__version__}

The notebook `{KERNEL_SLUG}` uses these files to make a submission to the Image Matching Challenge 2022 without
internet.

| file | content |
| --- | --- |
| `mkpc_kaggle-*.whl` | the package: two-stage image matching with Matching Key-Points Crop |
| other `*.whl` | packages that may be missing on Kaggle; each has its licence inside |
| `requirements.txt` | the versions that the notebook installs |
| `*.safetensors` | weights of image matchers, converted from the published checkpoints |
| `weights_manifest.txt` | size, digest, licence and source of each weight file |

The package is under Apache-2.0. Licences of the weights: {named}.

Add this dataset and the competition to the notebook under *Add Input*, switch the internet off, save a version.
`mkpc package` in the project's repository makes these files.
"""


def _json(table: dict[str, object]) -> str:
    return json.dumps(table, indent=2) + "\n"
