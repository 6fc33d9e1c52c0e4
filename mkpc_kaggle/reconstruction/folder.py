"""A folder of images: its datasets, and the pairs of each that are to be matched."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from mkpc_kaggle.data.competition import CONTROL, IMAGE_SUFFIXES
from mkpc_kaggle.errors import UserError, read_text
from mkpc_kaggle.reconstruction.likeness import shortlist

MAX_IMAGES = 100  # of which all pairs are matched; above, each image has a shortlist

Ends = tuple[Path, Path]


@dataclass(frozen=True)
class Dataset:
    """Images that are reconstructed together: ``name`` is their folder's below the root, "." the root itself."""

    name: str
    files: tuple[Path, ...]


def read_folder(root: Path) -> tuple[Dataset, ...]:
    """The datasets of a folder: each folder in it, and itself, that has images; all in order of names.

    Raises :class:`UserError` where there are no two images to match, and for two images of one stem.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such directory; name a folder of images, or of folders of images")
    datasets = []
    for folder in (root, *sorted(path for path in root.rglob("*") if path.is_dir())):
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
        stems: dict[str, Path] = {}
        for path in files:
            if CONTROL.search(path.name):
                raise UserError(f"{folder}: the name {path.name!r} has control characters; rename that file")
            if (other := stems.setdefault(path.stem, path)) is not path:
                raise UserError(f"{folder} has both {other.name} and {path.name}; rename one of them")
        if files:
            datasets.append(Dataset(folder.relative_to(root).as_posix(), tuple(files)))
    if not datasets:
        raise UserError(f"{root} has no images: name a folder with {', '.join(IMAGE_SUFFIXES)} files")
    if all(len(dataset.files) < 2 for dataset in datasets):
        raise UserError(f"{root} has a single image, {datasets[0].files[0].name}: there is nothing to match")
    return tuple(datasets)


def pairs_of(dataset: Dataset) -> list[Ends]:
    """All pairs of a dataset of up to ``MAX_IMAGES`` images; of a larger dataset, those of its shortlist."""
    if len(dataset.files) <= MAX_IMAGES:
        return list(combinations(dataset.files, 2))
    return [(dataset.files[first], dataset.files[second]) for first, second in shortlist(dataset.files)]


def read_pair_list(path: Path, root: Path, datasets: Iterable[Dataset]) -> list[Ends]:
    """The pairs of a list: a line each, two images by their paths below ``root``, as of hloc.

    Raises :class:`UserError` for a line that does not name two images of one dataset.
    """
    known = {file for dataset in datasets for file in dataset.files}
    found = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        ends = sorted(root / name for name in line.split())
        if not ends:
            continue
        if len(ends) != 2 or ends[0] == ends[1] or ends[0].parent != ends[1].parent or not known.issuperset(ends):
            raise UserError(f"{path}, line {number}: expected two images of one dataset of {root}, found {line!r}")
        found.append((ends[0], ends[1]))
    if not found:
        raise UserError(f"{path} has no pairs")
    return list(dict.fromkeys(found))
