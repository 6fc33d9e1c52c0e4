"""The folders that a Kaggle user uploads: a dataset of wheels and weights, and the notebook.

The JSON files are those of the ``kaggle`` command: docs/datasets_metadata.md and
docs/kernels_metadata.md there.
"""

import json
import re
import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from pathlib import Path
from string import Template

from mkpc_kaggle.errors import UserError, temporary_directory, writing
from mkpc_kaggle.progress import counted, print_to
from mkpc_kaggle.version import __version__
from mkpc_kaggle.weights import FoundFile, WeightFile, WeightStore, load_tensors
from mkpc_kaggle.weights.fetch import run_pip
from mkpc_kaggle.weights.manifest import MANIFEST, digest_of

COMPETITION = "image-matching-challenge-2022"
DATASET = "mkpc-kaggle"
DATASET_METADATA = "dataset-metadata.json"
KERNEL_TITLE = "MKPC submission"
KERNEL = "mkpc-submission"  # Kaggle derives it from the title
NOTEBOOK = Path("notebooks", "submission.ipynb")
# Direct and indirect dependencies that may be missing or too old in Kaggle's image.
BUNDLED = ("kornia", "kornia-rs", "pycolmap", "safetensors")
# Of Kaggle's current, older pinned and probable next images.
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
# pip matches these names exactly: an older wheel has an older name.
PLATFORMS = ("manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64")


@dataclass(frozen=True)
class Package:
    """The paths of both folders' files."""

    dataset: tuple[Path, ...]
    kernel: tuple[Path, ...]
    weights: tuple[WeightFile, ...]  # in the dataset
    restricted: tuple[WeightFile, ...]  # whose licences do not allow redistribution


def make_package(
    out: Path,
    owner: str,
    weights: Sequence[Path] = (),
    *,
    pythons: Sequence[str] = PYTHONS,
    wheels: Path | None = None,
    private: bool = False,
) -> Package:
    """Write the folders of dataset and kernel below ``out``.

    ``owner`` is a Kaggle user name, ``weights`` are directories. ``wheels``, a directory, replaces
    pip's index. ``private`` includes weights whose licences do not allow redistribution. The same
    arguments give the same bytes. Raises :class:`UserError` if the package runs outside a checkout,
    a folder has other files, weights cannot be read, or wheels cannot be built or found.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9-]*", owner):
        raise UserError(
            f"--owner {owner!r} cannot be a Kaggle user name: give the last part of your profile's address, "
            "letters, digits and dashes"
        )
    for python in pythons:
        if not re.fullmatch(r"3\.[0-9]{1,2}", python):
            raise UserError(
                f"--python {python[:20]!r}: expected versions such as {PYTHONS[0]}"
            )
    if wheels is not None and not wheels.is_dir():
        raise UserError(f"--wheels {wheels}: no such directory")
    checkout = find_checkout()
    store = WeightStore(weights)
    slots = dict.fromkeys(file.slot for file in store.files)
    found = [file for slot in slots if (file := store.file_of(slot)) is not None]
    texts = licence_texts(checkout)
    restricted = [each.file for each in found if each.file.licence not in texts]
    shipped = [each for each in found if private or each.file not in restricted]
    licences = sorted({each.file.licence for each in shipped})
    with temporary_directory() as staging:
        dataset = staging / "dataset"
        kernel = staging / "kernel"
        dataset.mkdir()
        kernel.mkdir()
        shutil.copyfile(checkout / NOTEBOOK, kernel / NOTEBOOK.name)
        table = kernel_metadata(owner, has_gpu=bool(shipped))
        write_text(kernel / "kernel-metadata.json", json.dumps(table, indent=2) + "\n")
        # Quick steps first, so that a wrong one is reported before gigabytes are converted.
        collect_wheels(checkout, dataset, pythons, wheels)
        table = dataset_metadata(owner, licences)
        write_text(dataset / DATASET_METADATA, json.dumps(table, indent=2) + "\n")
        page = Template(Path(__file__).with_name("page.md").read_text(encoding="utf-8"))
        named = ", ".join(licences) or "none, this dataset has no weights"
        text = page.substitute(version=__version__, kernel=KERNEL, licences=named)
        write_text(dataset / "README.md", text)
        shutil.copyfile(checkout / "LICENSE", dataset / "LICENSE")
        for licence in licences:
            # The package's own is there.
            if licence in texts and texts[licence].name != "LICENSE":
                shutil.copyfile(texts[licence], dataset / texts[licence].name)
        files = [as_safetensors(each, dataset) for each in shipped]
        write_text(dataset / MANIFEST, "\n".join(map(table_of, files)))
        for folder in (dataset, kernel):
            refuse_other_files(out / folder.name, folder)
        with writing(str(out)):
            return Package(
                publish(dataset, out / "dataset"),
                publish(kernel, out / "kernel"),
                tuple(files),
                tuple(restricted),
            )


def dataset_metadata(owner: str, licences: Sequence[str]) -> dict[str, object]:
    """Return ``dataset-metadata.json``. Kaggle allows one licence; the description lists all."""
    return {
        "id": f"{owner}/{DATASET}",
        "title": f"MKPC Kaggle {__version__}",
        "subtitle": "Offline two-stage image matching: wheels and weights",
        "description": "mkpc_kaggle (Apache-2.0), the wheels that it needs (each has its licence inside), and "
        "weights of image matchers. weights_manifest.txt names the licence and the source of each file of "
        f"weights. Licences of the weights here: {', '.join(licences) or 'none, no weights'}.",
        "licenses": [{"name": "other"}],
    }


def kernel_metadata(owner: str, *, has_gpu: bool) -> dict[str, object]:
    """Return ``kernel-metadata.json``: the competition and our dataset are attached.

    With ``has_gpu``, the notebook asks for two T4 GPUs. Without weights they would idle and use up
    the quota.
    """
    machine = {"machine_shape": "NvidiaTeslaT4"} if has_gpu else {}
    return {
        "id": f"{owner}/{KERNEL}",
        "title": KERNEL_TITLE,
        "code_file": NOTEBOOK.name,
        "language": "python",
        "kernel_type": "notebook",
        "is_private": True,
        "enable_gpu": has_gpu,
        **machine,
        "docker_image_pinning_type": "latest",
        # The rules of the competition.
        "enable_internet": False,
        "competition_sources": [COMPETITION],
        "dataset_sources": [f"{owner}/{DATASET}"],
        "kernel_sources": [],
        "model_sources": [],
    }


def licence_texts(checkout: Path) -> dict[str, Path]:
    """Return the texts of the licences that allow redistribution, by tag as in the manifest."""
    texts = {path.stem: path for path in (checkout / "licences").glob("*.txt")}
    texts["Apache-2.0"] = checkout / "LICENSE"  # the package's own licence
    return texts


def collect_wheels(
    checkout: Path, directory: Path, pythons: Iterable[str], wheels: Path | None
) -> None:
    """Write our wheel, the wheels of :data:`BUNDLED` packages, and ``requirements.txt``.

    Raises :class:`UserError` if a wheel is not found.
    """
    build_wheel(checkout, directory)
    # The versions that the tests use. A package has several spellings of its name.
    lines = (checkout / "requirements-dev.txt").read_text(encoding="utf-8").splitlines()
    pinned = [line for line in lines if line.partition("==")[0].replace("_", "-") in BUNDLED]
    write_text(
        directory / "requirements.txt",
        "\n".join([f"mkpc-kaggle=={__version__}", *pinned, ""]),
    )
    platforms = [option for platform in PLATFORMS for option in ("--platform", platform)]
    source = [] if wheels is None else ["--no-index", "--find-links", str(wheels)]
    options = [
        "--only-binary=:all:",
        "--no-deps",
        *platforms,
        *source,
        "--dest",
        str(directory),
    ]
    for python in counted([*pythons], "wheels by pip", "Python"):
        failure = run_pip("download", *options, "--python-version", python, *pinned)
        if failure:
            raise UserError(
                f"no wheels of {', '.join(pinned)} for Python {python} on Linux x86-64: {failure}. "
                "On a machine without internet, give a directory of wheels with --wheels."
            )


def build_wheel(checkout: Path, directory: Path) -> None:
    """Build our wheel; the same sources give the same bytes. Raise :class:`UserError`."""
    # If hatchling is not installed, pip downloads it for the build.
    isolation = ["--no-build-isolation"] if find_spec("hatchling") else []
    print_to(sys.stderr, "building the wheel of this checkout with pip")
    failure = run_pip("wheel", "--no-deps", *isolation, "--wheel-dir", directory, checkout)
    if failure:
        raise UserError(f"the wheel could not be built from {checkout}: {failure}")


def as_safetensors(found: FoundFile, directory: Path) -> WeightFile:
    """Write a weight file as safetensors, and return its entry of the dataset's manifest.

    Kaggle would unpack a torch checkpoint.
    """
    from safetensors.torch import save_file

    name = found.file.name
    source = found.file.source
    if found.path.suffix == ".safetensors":
        target = directory / name
        shutil.copyfile(found.path, target)
    else:
        # With its suffix: the manifest may list another conversion under the shorter name.
        target = directory / f"{name}.safetensors"
        source = f"{name} ({found.sha256}) with the same tensor names"
        # safetensors refuses views and tensors that share their bytes.
        tensors = load_tensors(found.path)
        save_file(
            {key: tensor.contiguous().clone() for key, tensor in tensors.items()}, target
        )
    return WeightFile(
        found.file.slot,
        found.file.licence,
        target.stat().st_size,
        digest_of(target),
        source=source,
        name=target.name,
    )


def table_of(file: WeightFile) -> str:
    """Return a file's table of a manifest."""
    # Strings of JSON are strings of TOML, too.
    lines = [f"[{json.dumps(file.name)}]"]
    for key, value in asdict(file).items():
        if value and key != "name":
            lines.append(f"{key} = {json.dumps(value)}")
    return "\n".join([*lines, ""])


def write_text(path: Path, text: str) -> None:
    """Write a text with the same bytes on every system."""
    path.write_text(text, encoding="utf-8", newline="\n")


def refuse_other_files(directory: Path, folder: Path) -> None:
    """Raise :class:`UserError` if ``directory`` has files that are not in ``folder``.

    They would be uploaded too.
    """
    names = {path.name for path in folder.iterdir()}
    others = sorted(path.name for path in directory.glob("*") if path.name not in names)
    if others:
        raise UserError(
            f"{directory} contains files that would be uploaded too: {', '.join(others)}. Remove them, or choose "
            "another --out."
        )


def publish(folder: Path, directory: Path) -> tuple[Path, ...]:
    """Move the files of ``folder`` to ``directory``; return their new paths."""
    directory.mkdir(parents=True, exist_ok=True)
    paths = []
    for path in sorted(folder.iterdir()):
        shutil.move(path, directory / path.name)
        paths.append(directory / path.name)
    return tuple(paths)


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
