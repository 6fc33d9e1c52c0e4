"""Causes of a dataset without any match that its files show."""

from collections.abc import Sequence
from pathlib import Path

from mkpc_kaggle.data.images import Image, read_image
from mkpc_kaggle.data.masks import Masks, read_mask
from mkpc_kaggle.errors import UserError

SAMPLES = 3  # files that are read, spread over the dataset
# Largest value of a photograph that is almost black. 12 bits in a file of 16 give 15, 14 bits 63.
MAX_DARK = 63
MAX_SPREAD = 2.0  # standard deviation of the values of an image without any structure


def cause_of_no_matches(files: Sequence[Path], masks: Masks) -> str:
    """Return why no two of these images have matches, or an empty string."""
    step = max(1, (len(files) - 1) // max(1, SAMPLES - 1))
    sample = files[::step][:SAMPLES]
    if all(_is_hidden(file, masks) for file in sample):
        return "the masks hide everything: black pixels are left out; invert the masks"
    images = [image for image in map(read_image, sample) if isinstance(image, Image)]
    if not images:  # each of them is reported as unreadable
        return ""
    brightest = max(images, key=lambda image: int(image.pixels.max()))
    maximum = int(brightest.pixels.max())
    if maximum <= MAX_DARK:
        return (
            f"the photographs are almost black: the maximum of {Path(brightest.name).name} is "
            f"{maximum} of 255; values of 10, 12 or 14 bits must be scaled to all 16 bits of a file"
        )
    if all(float(image.gray.std()) < MAX_SPREAD for image in images):
        return f"the photographs have no structure: all of {Path(images[0].name).name} has one brightness"
    return ""


def _is_hidden(file: Path, masks: Masks) -> bool:
    if str(file) not in masks.files:
        return False
    try:
        return not read_mask(Path(masks.files[str(file)][0])).any()
    except UserError:  # it was removed during the run, whose lines report that
        return False
