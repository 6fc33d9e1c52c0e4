"""A folder of images: its datasets, and the pairs of each that are to be matched."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

from mkpc_kaggle.data.competition import CONTROL, IMAGE_SUFFIXES
from mkpc_kaggle.errors import UserError, read_text
from mkpc_kaggle.reconstruction.likeness import shortlist

MAX_IMAGES = 100  # of which all pairs are matched; above, each image has a shortlist

Datasets = Mapping[str, Sequence[Path]]  # images that belong together, by their folder's name below the root
Ends = tuple[Path, Path]


def read_folder(root: Path) -> Datasets:
    """The datasets of a folder: each folder in it, and itself, ".", that has images; all in order of names.

    Raises :class:`UserError` where there are no two images to match, and for two images of one stem.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such directory; name a folder of images, or of folders of images")
    datasets = {}
    for folder in (root, *sorted(path for path in root.rglob("*") if path.is_dir())):
        files = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
        stems: dict[str, Path] = {}
        for path in files:
            if CONTROL.search(path.name):
                raise UserError(f"{folder}: the name {path.name!r} has control characters; rename that file")
            if (other := stems.setdefault(path.stem, path)) is not path:
                raise UserError(f"{folder} has both {other.name} and {path.name}; rename one of them")
        if files:
            datasets[folder.relative_to(root).as_posix()] = files
    if not datasets:
        raise UserError(f"{root} has no images: name a folder with {', '.join(IMAGE_SUFFIXES)} files")
    if all(len(files) < 2 for files in datasets.values()):
        name = next(iter(datasets.values()))[0].name
        raise UserError(f"{root} has a single image, {name}: there is nothing to match")
    return datasets


def pairs_of(files: Sequence[Path]) -> list[Ends]:
    """All pairs of up to ``MAX_IMAGES`` images; of more, those of their shortlist."""
    if len(files) <= MAX_IMAGES:
        return list(combinations(files, 2))
    return [(files[first], files[second]) for first, second in shortlist(files)]


def read_pair_list(path: Path, root: Path, datasets: Datasets) -> list[Ends]:
    """The pairs of a list: a line each, two images by their paths below ``root``, as of hloc.

    Raises :class:`UserError` for a line that does not name two images of one dataset.
    """
    known = {file for files in datasets.values() for file in files}
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
