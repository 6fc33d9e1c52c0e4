"""Regions that the user gives for stage 2, in place of MKPC's."""

from collections.abc import Iterable, Mapping
from pathlib import Path

from mkpc_kaggle.config import whole
from mkpc_kaggle.data.competition import Pair, read_rows
from mkpc_kaggle.data.images import read_size
from mkpc_kaggle.errors import UserError, plural
from mkpc_kaggle.geometry.coordinates import Box

GivenRegions = Mapping[tuple[str, ...], tuple[Box, Box]]  # by the names of both images


def read_regions(file: Path, image_root: Path, pairs: Iterable[Pair]) -> GivenRegions:
    """Return the stage-2 boxes of a table, keyed by the image files of a pair.

    ``file`` has columns ``image_0,image_1,box_0,box_1``: paths under the root; left, top, right,
    bottom of boxes in whole pixels of the stored image. Right and bottom are exclusive. Raises
    :class:`UserError` for a malformed table, for a box that is malformed or extends beyond its
    image, and for a missing pair. A row may have a pair's images in either order.
    """
    boxes: dict[tuple[str, ...], tuple[Box, Box]] = {}
    columns = ("image_0", "image_1", "box_0", "box_1")
    for where, (name0, name1, *cells) in read_rows(file, columns):
        try:
            box0, box1 = (Box(*map(whole, filter(None, cell.split(" ")))) for cell in cells)
        except (ValueError, TypeError) as error:
            found = f"{cells[0]!r} and {cells[1]!r}"
            raise UserError(
                f"{where}: expected left, top, right and bottom of a box, found {found}"
            ) from error
        boxes[str(image_root / name0), str(image_root / name1)] = (box0, box1)
    wanted = {pair.id: (pair.file0, pair.file1) for pair in pairs}
    asked = set(wanted.values())
    for files in asked:
        # A row may have the two images in the other order.
        other = files[::-1]
        if files not in boxes and other in boxes:
            first, second = boxes[other] if other in asked else boxes.pop(other)
            boxes[files] = second, first
    without = [name for name, files in wanted.items() if files not in boxes]
    if without:
        count = f"; {len(without)} of {plural(len(wanted), 'pair')} have none"
        raise UserError(f"{file} has no regions of the pair {without[0]}{count}")
    # Checked now: an error in the middle of a run would cost hours.
    for files in wanted.values():
        for path, box in zip(files, boxes[files], strict=True):
            size = read_size(Path(path))  # an unreadable image is reported by the run
            if size and (box.right > size.width or box.bottom > size.height):
                raise UserError(
                    f"{file}: a box ends at {box.right}, {box.bottom}, beyond {path} "
                    f"of {size.width} x {size.height} pixels"
                )
    return boxes
