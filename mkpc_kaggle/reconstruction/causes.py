"""Causes that the files show why images have no camera."""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.data.masks import Masks, read_mask
from mkpc_kaggle.errors import UserError

MAX_FILES = 12  # that are decoded, spread over the images; 24 megapixels take 0.3 s
MAX_SAMPLED_PIXELS = 1_000_000  # of an image, for percentiles and shares
# Largest value of a photograph that is almost black. 12 bits in a file of 16 give 15, 14 bits 63.
MAX_DARK = 63
DARK_PERCENTILE = 99.9  # of the values; the others may be lamps, or defects of the sensor
MIN_WHITE = 250
WHITE_SHARE = 0.5  # of the pixels of an overexposed photograph
MAX_SPREAD = 2.0  # standard deviation of the values of an image without any structure


class FileCause(NamedTuple):
    """A kind of cause, and the sentence about the first file that shows it."""

    kind: str
    sentence: str


MIN_SHOWN = 0.05  # share of an image; a mask that shows less is often inverted


def causes_in_files(files: Sequence[Path], masks: Masks) -> Iterator[str]:
    """Yield a sentence for each cause why some of these images have no camera, with their names.

    No sentence is about images without a cause, nor about images that cannot be read.
    """
    step = -(-len(files) // MAX_FILES) or 1
    sample = files[::step]
    counts = Counter(file.name for file in files)
    sentences: dict[str, str] = {}
    names: dict[str, list[str]] = {}
    for file in sample:
        cause = _cause_in_file(file, masks)
        if cause is not None:
            sentences.setdefault(cause.kind, cause.sentence)
            is_unique = counts[file.name] == 1
            label = file.name if is_unique else f"{file.parent.name}/{file.name}"
            names.setdefault(cause.kind, []).append(label)
    others = f"; {len(sample)} of {len(files)} files were read" if step > 1 else ""
    for kind, sentence in sentences.items():
        yield f"{sentence}: {', '.join(names[kind])}{others}"


def _cause_in_file(file: Path, masks: Masks) -> FileCause | None:
    """Return why nothing in an image matches, if its files show that."""
    shown = _shown_share(file, masks)
    if shown == 0:
        return FileCause(
            "hidden", "the masks hide everything, since black is left out; invert them"
        )
    if shown < MIN_SHOWN:
        share = f"{100 * (1 - shown):.0f} % of {file.name}"
        return FileCause(
            "almost hidden",
            f"the masks hide almost everything, {share}; invert them if they hide the wrong part",
        )
    image = read_image(file)
    # An unreadable image has its own line.
    return _cause_in_pixels(image) if isinstance(image, Image) else None


def _cause_in_pixels(image: Image) -> FileCause | None:
    name = Path(image.name).name
    step = max(1, round((image.pixels.size / 3 / MAX_SAMPLED_PIXELS) ** 0.5))
    pixels = image.pixels[::step, ::step]
    maximum = int(image.pixels.max())
    usual_maximum = int(np.percentile(pixels, DARK_PERCENTILE))
    if usual_maximum <= MAX_DARK:
        value = f"the maximum of {name} is {maximum} of 255"
        if maximum > MAX_DARK:
            value = f"{DARK_PERCENTILE:g} % of {name} are at most {usual_maximum} of 255"
        return FileCause(
            "dark",
            f"the photographs are almost black: {value}; values of 10, 12 or 14 bits must be scaled "
            "to all 16 bits of a file",
        )
    if float(image.gray.std()) < MAX_SPREAD:
        return FileCause(
            "flat", f"the photographs have no structure: all of {name} has one brightness"
        )
    white = float((pixels.min(axis=2) >= MIN_WHITE).mean())
    if white > WHITE_SHARE:
        return FileCause(
            "white", f"the photographs are overexposed, {100 * white:.0f} % of {name} is white"
        )
    return None


def _shown_share(file: Path, masks: Masks) -> float:
    """Return the share of an image that its mask shows; 1 without a mask."""
    if str(file) not in masks.files:
        return 1.0
    try:
        return float(read_mask(Path(masks.files[str(file)][0])).mean())
    except UserError:  # it was removed during the run, whose lines report that
        return 1.0
