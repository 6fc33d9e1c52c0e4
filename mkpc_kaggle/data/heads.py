"""Heads of picture files: their size and their EXIF tags, for every format that OpenCV decodes.

Pillow's readers of the formats are called directly. ``PIL.Image.open`` refuses more than 179
megapixels, since it would decode them; here no pixel is decoded.
"""

import struct
import warnings
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from numbers import Real
from pathlib import Path
from typing import BinaryIO

import PIL.Image

from mkpc_kaggle.geometry.coordinates import Size

# Of EXIF and TIFF
ORIENTATION = 0x0112
DIRECTORY = 0x8769  # of the tags that only EXIF has
TIFF_WIDTH = 0x0100
TIFF_HEIGHT = 0x0101

# Pillow's names of the formats. The first bytes of a file decide, and not its name.
FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "AVIF", "JPEG2000", "PPM", "GIF")
MAX_PREFIX = 16  # bytes that Pillow knows a format by
# What Pillow raises for damaged files, seen with 50,000 of them. Its limit of pixels is only in
# readers that decode, and a shortage of memory is no damage.
DAMAGE = (
    SyntaxError,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
    ArithmeticError,
    RuntimeError,
    struct.error,
    PIL.Image.DecompressionBombError,
)
HEIC_BRANDS = frozenset({b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1"})
PNG_START = b"\x89PNG\r\n\x1a\n"
PNG_FIRST_CHUNK = b"\0\0\0\x0dIHDR"  # of 13 bytes
PNG_SIZE_AT = 16  # the offset of width, height, bits of a channel, and colour type
PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # of a colour type
PNG_CHUNKS_BYTES = 200  # heads, checksums and short texts
DEFLATE_RATIO = 1030  # the largest
PNG_ROW_BYTES = 3  # of one colour, by fast writers such as OpenCV's


# A TIFF file may also be a raw photograph.
STARTS = (b"\xff\xd8\xff", PNG_START, b"II*\0", b"MM\0*", b"\0\0\0\x0cjP  ")


def is_picture(path: Path) -> bool:
    """Return whether a file begins as a photograph's: JPEG, PNG, TIFF, WebP, HEIC, AVIF or JPEG 2000."""
    try:
        # A pipe or a device may never end.
        if not path.is_file():
            return False
        with path.open("rb") as stream:
            start = stream.read(MAX_PREFIX)
    except OSError:
        return False
    is_webp = start[:4] == b"RIFF" and start[8:12] == b"WEBP"
    is_heif = start[4:8] == b"ftyp" and start[8:12] in (*HEIC_BRANDS, b"avif")
    return start.startswith(STARTS) or is_webp or is_heif


def size_of(stream: BinaryIO) -> Size | None:
    """Return a picture's size in stored pixels; ``None`` if its head cannot be read."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="PIL")
            picture = _opened(stream)
            if picture is None:
                return None
            tags = getattr(picture, "tag_v2", {})
            # Pillow gives the upright size of TIFF; its tags have the stored one.
            if TIFF_WIDTH in tags and TIFF_HEIGHT in tags:
                return Size(int(tags[TIFF_WIDTH]), int(tags[TIFF_HEIGHT]))
            return Size(*picture.size)
    except DAMAGE:
        return None


def is_whole_png(data: bytes) -> bool:
    """Return whether a PNG file begins with its size, and all chunks fit their checksums. No pixel is
    decoded.
    """
    if not data.startswith(PNG_START + PNG_FIRST_CHUNK):
        return False
    view = memoryview(data)
    start = len(PNG_START)
    while start + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, start)
        end = start + 8 + length
        # The checksum is of the kind and the content.
        if view[end : end + 4] != zlib.crc32(view[start + 4 : end]).to_bytes(4, "big"):
            return False
        if kind == b"IEND":
            return True
        start = end + 4
    return False


def may_have_one_colour(data: bytes) -> bool:
    """Return whether a whole PNG file is so small that all of its pixels may be equal."""
    width, height, depth, kind = struct.unpack_from(">IIBB", data, PNG_SIZE_AT)
    # A byte for each row says how it is filtered.
    stored = height * (1 + width * PNG_CHANNELS.get(kind, 4) * depth / 8)
    limit = stored / DEFLATE_RATIO + PNG_ROW_BYTES * height + PNG_CHUNKS_BYTES
    return bool(len(data) <= limit)


def exif_tags(data: bytes) -> dict[int, float]:
    """Return the numbers among the EXIF tags of a picture file, by tag; empty if damaged."""
    return _tags(lambda: _exif(data))


def tags_of_picture(picture: PIL.Image.Image) -> dict[int, float]:
    """Return the numbers among the EXIF tags of Pillow's picture, by tag; empty if damaged."""
    return _tags(picture.getexif)


def _tags(read: Callable[[], PIL.Image.Exif]) -> dict[int, float]:
    tags: dict[int, float] = {}
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="PIL")
            exif = read()
            for tag, value in {**exif, **exif.get_ifd(DIRECTORY)}.items():
                if isinstance(value, Real):
                    tags[tag] = float(value)
    except DAMAGE:
        return {}
    return tags


def is_tiff(data: bytes) -> bool:
    return data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def _exif(data: bytes) -> PIL.Image.Exif:
    """Return the EXIF of a picture file. Raises one of ``DAMAGE``."""
    exif = PIL.Image.Exif()
    # Pillow would decode all pixels of a PNG, since EXIF may come after them, and its reader of
    # WebP decodes.
    if data.startswith(PNG_START):
        exif.load(next(_chunks(data, len(PNG_START), ">I4s", b"eXIf", trailer=4), b""))
    elif data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        exif.load(next(_chunks(data, 12, "<4sI", b"EXIF", trailer=0), b""))
    elif (picture := _opened(BytesIO(data))) is not None:
        exif = picture.getexif()
    return exif


def _chunks(data: bytes, start: int, head: str, wanted: bytes, trailer: int) -> Iterator[bytes]:
    """Yield the contents of the chunks of a kind, from ``start``.

    ``head`` is the struct of a chunk's length and kind. ``trailer`` bytes follow a content. RIFF
    pads contents to an even length.
    """
    while start + 8 <= len(data):
        parts = struct.unpack_from(head, data, start)
        kind, length = parts if isinstance(parts[0], bytes) else parts[::-1]
        if kind == wanted:
            yield data[start + 8 : start + 8 + length]
        padding = 0 if trailer else length % 2
        start += 8 + length + padding + trailer


def _opened(stream: BinaryIO) -> PIL.Image.Image | None:
    """Return Pillow's picture of a stream; ``None`` for an unknown format. Raises ``DAMAGE``."""
    PIL.Image.init()
    prefix = stream.read(MAX_PREFIX)
    for name in FORMATS:
        # An older Pillow has no reader of AVIF.
        reader, accepts = PIL.Image.OPEN.get(name, (None, None))
        # A reader without its library answers with a text.
        if reader is not None and accepts is not None and accepts(prefix) is True:
            stream.seek(0)
            return reader(stream, "")
    return None
