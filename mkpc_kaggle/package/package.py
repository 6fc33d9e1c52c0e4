"""The dataset and kernel folders, made from a checkout, weights and an index of wheels."""

import re
from dataclasses import dataclass
from pathlib import Path

from mkpc_kaggle.errors import UserError, temporary_directory
from mkpc_kaggle.package.files import (
    ChosenWeights,
    PackageFile,
    choose_weights,
    refuse_other_files,
    write_items,
)
from mkpc_kaggle.package.metadata import (
    DATASET_METADATA,
    KAGGLE_MODELS,
    LATEST,
    check_owner,
    dataset_metadata,
    dataset_page,
    kernel_metadata,
)
from mkpc_kaggle.package.wheels import (
    PYTHONS,
    build_wheel,
    collect_wheels,
    install_lines,
    licence_of,
    pins,
)
from mkpc_kaggle.version import __version__
from mkpc_kaggle.weights import WeightStore
from mkpc_kaggle.weights.manifest import MANIFEST

NOTEBOOK = Path("notebooks", "submission.ipynb")


@dataclass(frozen=True)
class PackageRequest:
    """The options of the command ``package``."""

    out: Path
    owner: str  # a Kaggle user name
    weights: tuple[Path, ...] = ()  # directories
    pythons: tuple[str, ...] = PYTHONS
    wheels: Path | None = None  # a directory of wheels, used instead of pip's index
    private: bool = False  # include weights whose licence forbids redistribution
    image: str = LATEST  # a Kaggle image, see :func:`kernel_metadata`
    models: bool = False  # attach ALIKED and LightGlue from Kaggle Models


@dataclass(frozen=True)
class Package:
    """The files of both folders, and the weights whose licences forbid redistribution."""

    dataset: tuple[PackageFile, ...]
    kernel: tuple[PackageFile, ...]
    restricted: tuple[PackageFile, ...]


def make_package(request: PackageRequest) -> Package:
    """Write the folders of dataset and kernel, and return their files.

    The same request gives the same bytes. Raises :class:`UserError` before anything is written: if
    the package runs outside a checkout, a folder has other files, weights are damaged, or wheels
    cannot be built or found.
    """
    _check(request)
    checkout = find_checkout()
    dataset = request.out / "dataset"
    kernel = request.out / "kernel"
    with temporary_directory() as staging:
        store = WeightStore(request.weights)
        chosen = choose_weights(store, checkout, staging, private=request.private)
        kernel_items = _kernel_items(request, checkout, staging, has_weights=bool(chosen.items))
        dataset_items = _dataset_items(request, checkout, staging, chosen, dataset)
        # Both, before the first file is written.
        refuse_other_files(dataset, dataset_items)
        refuse_other_files(kernel, kernel_items)
        return Package(
            write_items(dataset, dataset_items),
            write_items(kernel, kernel_items),
            chosen.restricted,
        )


def _check(request: PackageRequest) -> None:
    """Raise :class:`UserError` for options that cannot be right, before any work."""
    check_owner(request.owner)
    for python in request.pythons:
        if not re.fullmatch(r"3\.[0-9]{1,2}", python):
            known = ",".join(PYTHONS)
            raise UserError(
                f"--python {python[:20]!r}: expected versions of Python 3 such as {known}"
            )
    if request.wheels is not None and not request.wheels.is_dir():
        raise UserError(f"--wheels {request.wheels}: no such directory")


def _kernel_items(
    request: PackageRequest, checkout: Path, staging: Path, *, has_weights: bool
) -> tuple[PackageFile, ...]:
    """Return the files of the kernel's folder."""
    metadata = kernel_metadata(
        request.owner,
        NOTEBOOK.name,
        request.image,
        has_gpu=has_weights or request.models,
        models=KAGGLE_MODELS if request.models else (),
    )
    notebook = PackageFile(NOTEBOOK.name, checkout / NOTEBOOK)
    return (_text(staging, "kernel-metadata.json", metadata), notebook)


def _dataset_items(
    request: PackageRequest, checkout: Path, staging: Path, chosen: ChosenWeights, dataset: Path
) -> tuple[PackageFile, ...]:
    """Return the files of the dataset's folder, for which wheels are built and collected."""
    licences = [item.licence for item in chosen.items]
    own = build_wheel(checkout, staging / "own")
    others = collect_wheels(
        pins(checkout), request.pythons, staging / "others", kept=dataset, wheels=request.wheels
    )
    requirements = "\n".join(install_lines(own, others)) + "\n"
    return (
        _text(staging, DATASET_METADATA, dataset_metadata(request.owner, licences)),
        *(PackageFile(path.name, path, licence_of(path)) for path in (own, *others)),
        _text(staging, "requirements.txt", requirements),
        _text(staging, "README.md", dataset_page(licences)),
        PackageFile("LICENSE", checkout / "LICENSE"),
        # The manifest of the converted files, which the store reads after the package's own.
        _text(staging, MANIFEST, chosen.manifest),
        *chosen.licence_texts,
        *chosen.items,
    )


def _text(staging: Path, name: str, content: str) -> PackageFile:
    """Write a text to the staging folder, with the same bytes on every system."""
    (staging / name).write_text(content, encoding="utf-8", newline="\n")
    return PackageFile(name, staging / name)


def find_checkout() -> Path:
    """Return the checkout that this package runs from, or else the current directory.

    Raises :class:`UserError` if neither is a checkout of this version.
    """
    ours = Path(__file__).resolve().parents[2]
    if (ours / NOTEBOOK).is_file():
        return ours
    # The package was installed as a copy; README's commands run in the clone.
    here = Path.cwd()
    version = here / "mkpc_kaggle" / "version.py"
    if (here / NOTEBOOK).is_file() and version.is_file():
        if f'"{__version__}"' in version.read_text(encoding="utf-8"):
            return here
        raise UserError(
            f"the clone in {here} has another version than the installed one, {__version__}: install it again"
        )
    raise UserError(
        f"mkpc_kaggle is installed in {ours} without its sources, which `package` needs to build the wheel: "
        "run `mkpc package` in a clone of the repository"
    )
