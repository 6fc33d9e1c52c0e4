"""The dataset folder and the kernel folder, from a checkout, weights and an index of wheels."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.package.checkout import Checkout, find_checkout
from mkpc_kaggle.package.folder import Item, refuse_other_files, write_files
from mkpc_kaggle.package.metadata import Image, check_owner, dataset_metadata, kernel_metadata
from mkpc_kaggle.package.weights import ChosenWeights, choose_weights
from mkpc_kaggle.package.wheels import PYTHONS, build_wheel, collect_wheels, install_lines, licence_of, pins
from mkpc_kaggle.weights import WeightStore
from mkpc_kaggle.weights.manifest import MANIFEST


@dataclass(frozen=True)
class Request:
    """``owner`` is a user of Kaggle; ``pythons`` are versions such as ``3.11``.

    ``wheels`` is a directory to take wheels from, instead of pip's index. ``private`` includes weights that must
    not be redistributed. ``image`` says which of its images Kaggle should run the kernel on.
    """

    out: Path
    owner: str
    weights: tuple[Path, ...] = ()
    pythons: tuple[str, ...] = PYTHONS
    wheels: Path | None = None
    private: bool = False
    image: Image = Image.LATEST


@dataclass(frozen=True)
class Package:
    """What was written: the files of both folders, and the weights whose licences do not allow redistribution."""

    dataset: tuple[Item, ...]
    kernel: tuple[Item, ...]
    restricted: tuple[Item, ...]


def make_package(request: Request) -> Package:
    """Write both folders; the same request gives the same bytes, and files that are there already are kept.

    Raises :class:`UserError`, before anything is written, without a checkout, for files in the folders that do not
    belong there, for damaged weights, and where wheels cannot be built or found.
    """
    check_owner(request.owner)
    if request.wheels is not None and not request.wheels.is_dir():
        raise UserError(f"--wheels {request.wheels}: no such directory")
    checkout = find_checkout()
    dataset, kernel = request.out / "dataset", request.out / "kernel"
    with TemporaryDirectory(prefix="mkpc-") as temporary:
        staging = Path(temporary)
        chosen = choose_weights(WeightStore(request.weights), checkout, staging, private=request.private)
        dataset_items = _dataset_items(request, checkout, chosen, staging)
        kernel_items = _kernel_items(request, checkout, staging)
        refuse_other_files(dataset, dataset_items)
        refuse_other_files(kernel, kernel_items)
        write_files(dataset, dataset_items)
        write_files(kernel, kernel_items)
    return Package(_written(dataset, dataset_items), _written(kernel, kernel_items), chosen.restricted)


def _dataset_items(request: Request, checkout: Checkout, chosen: ChosenWeights, staging: Path) -> tuple[Item, ...]:
    own, others = staging / "own", staging / "others"
    wheel = build_wheel(checkout, own)
    wheels = collect_wheels(
        pins(checkout), request.pythons, others, kept=request.out / "dataset", wheels=request.wheels
    )
    licences = [item.licence for item in chosen.items]
    return (
        _text(staging, "dataset-metadata.json", dataset_metadata(request.owner, licences)),
        *(Item(path.name, path, licence_of(path)) for path in (wheel, *wheels)),
        _text(staging, "requirements.txt", "\n".join(install_lines(wheel, wheels)) + "\n"),
        Item("LICENSE", checkout.licence),
        _text(staging, MANIFEST, chosen.manifest),
        *chosen.licence_texts,
        *chosen.items,
    )


def _kernel_items(request: Request, checkout: Checkout, staging: Path) -> tuple[Item, ...]:
    notebook = checkout.submission_notebook
    return (
        _text(staging, "kernel-metadata.json", kernel_metadata(request.owner, notebook.name, request.image)),
        Item(notebook.name, notebook),
    )


def _text(staging: Path, name: str, text: str) -> Item:
    path = staging / name
    path.write_text(text, encoding="utf-8", newline="\n")
    return Item(name, path)


def _written(directory: Path, items: tuple[Item, ...]) -> tuple[Item, ...]:
    return tuple(Item(item.name, directory / item.name, item.licence, item.note) for item in items)
