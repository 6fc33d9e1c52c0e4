"""The dataset and kernel folders, made from a checkout, weights and an index of wheels."""

import re
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from mkpc_kaggle.errors import UserError
from mkpc_kaggle.package.files import Item, choose_weights, refuse_other_files, write_files
from mkpc_kaggle.package.metadata import (
    LATEST,
    MODELS,
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
from mkpc_kaggle.weights import WeightStore
from mkpc_kaggle.weights.manifest import MANIFEST

NOTEBOOK = Path("notebooks", "submission.ipynb")


@dataclass(frozen=True)
class Request:
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

    dataset: tuple[Item, ...]
    kernel: tuple[Item, ...]
    restricted: tuple[Item, ...]


def make_package(request: Request) -> Package:
    """Write the folders of dataset and kernel, and return their files. The same request gives the
    same bytes.

    Raises :class:`UserError` before anything is written: if the package runs outside a checkout, a
    folder has other files, weights are damaged, or wheels cannot be built or found.
    """
    check_owner(request.owner)
    if wrong := [
        python for python in request.pythons if not re.fullmatch(r"3\.[0-9]{1,2}", python)
    ]:
        raise UserError(
            f"--python {wrong[0][:20]!r}: expected versions of Python 3 such as {','.join(PYTHONS)}"
        )
    if request.wheels is not None and not request.wheels.is_dir():
        raise UserError(f"--wheels {request.wheels}: no such directory")
    checkout = find_checkout()
    dataset, kernel = request.out / "dataset", request.out / "kernel"
    with TemporaryDirectory(prefix="mkpc-") as temporary:
        staging = Path(temporary)

        def text(name: str, content: str) -> Item:
            (staging / name).write_text(content, encoding="utf-8", newline="\n")
            return Item(name, staging / name)

        chosen = choose_weights(
            WeightStore(request.weights), checkout, staging, private=request.private
        )
        licences = [item.licence for item in chosen.items]
        kernel_json = kernel_metadata(
            request.owner,
            NOTEBOOK.name,
            request.image,
            has_gpu=bool(chosen.items) or request.models,
            models=MODELS if request.models else (),
        )
        kernel_items = (
            text("kernel-metadata.json", kernel_json),
            Item(NOTEBOOK.name, checkout / NOTEBOOK),
        )
        own = build_wheel(checkout, staging / "own")
        others = collect_wheels(
            pins(checkout), request.pythons, staging / "others", kept=dataset, wheels=request.wheels
        )
        dataset_items = (
            text("dataset-metadata.json", dataset_metadata(request.owner, licences)),
            *(Item(path.name, path, licence_of(path)) for path in (own, *others)),
            text("requirements.txt", "\n".join(install_lines(own, others)) + "\n"),
            text("README.md", dataset_page(licences)),
            Item("LICENSE", checkout / "LICENSE"),
            text(MANIFEST, chosen.manifest),
            *chosen.licence_texts,
            *chosen.items,
        )
        refuse_other_files(dataset, dataset_items)
        refuse_other_files(kernel, kernel_items)
        return Package(
            write_files(dataset, dataset_items),
            write_files(kernel, kernel_items),
            chosen.restricted,
        )


def find_checkout() -> Path:
    """Return the checkout that this package runs from. Raise :class:`UserError` for an installed
    wheel.
    """
    root = Path(__file__).resolve().parents[2]
    if not (root / NOTEBOOK).is_file():
        raise UserError(
            f"mkpc_kaggle was installed in {root} without its sources, which `package` needs to build the wheel: "
            "clone the repository and run `mkpc package` in the clone"
        )
    return root
