"""The resolution that a calibration is for, by its principal point: lenses are centred to a few percent.

Points are in COLMAP's pixels: (0, 0) is the corner of the top-left pixel.
"""

from fractions import Fraction

from mkpc_kaggle.geometry.coordinates import Matrix3, Size

# Offset of a principal point from the middle of its image, as a share of the sides. A calibration
# for three quarters of the resolution is 0.125 off.
MAX_OFFSET = 0.1
MAX_DENOMINATOR = 4  # of the ratio of two usual resolutions
MAX_SCALE_ERROR = 0.03  # of this ratio by the principal point
MAX_SHAPE_RATIO = 1.05  # of pictures of one camera at two resolutions

Point = tuple[float, float]


def doubt_about_resolution(K: Matrix3, size: Size) -> str:
    """Return why a camera matrix, for pixels whose centres are integers, seems to be for another
    image than one of this size; empty if it does not.
    """
    point = (float(K[0, 2]) + 0.5, float(K[1, 2]) + 0.5)
    if offset_from_middle(point, size) <= MAX_OFFSET:
        return ""
    text = f"{text_of_point(point, size)} of an image of {text_of(size)} pixels"
    other = size_around(point, size)
    return text if other is None else f"{text}; the matrix seems to be for {text_of(other)}"


def offset_from_middle(point: Point, size: Size) -> float:
    """Return the offset of a point from the middle, as a share of the sides."""
    x, y = point
    return max(abs(x / size.width - 0.5), abs(y / size.height - 0.5))


def text_of_point(point: Point, size: Size) -> str:
    x, y = point
    is_inside = 0 <= x < size.width and 0 <= y < size.height
    return (
        f"the principal point {x:g}, {y:g} is {'far from the middle' if is_inside else 'outside'}"
    )


def size_around(point: Point, size: Size) -> Size | None:
    """Return the size of the pictures that this principal point seems to be for, given that of the
    image; ``None`` if it has another shape.
    """
    x, y = point
    # The size in whose middle the point would be, which is a few percent wrong
    rough = Size(max(1, round(2 * x)), max(1, round(2 * y)))
    for shape in (size, Size(size.height, size.width)):
        if not is_same_shape(rough, shape):
            continue
        scale = ((rough.width / shape.width) * (rough.height / shape.height)) ** 0.5
        # Pictures are reduced to a half or to three quarters, and not to 0.496.
        simple = Fraction(max(scale, 1 / scale)).limit_denominator(MAX_DENOMINATOR)
        exact = float(simple if scale > 1 else 1 / simple)
        if abs(exact / scale - 1) < MAX_SCALE_ERROR:
            scale = exact
        return Size(max(1, round(scale * shape.width)), max(1, round(scale * shape.height)))
    return None


def is_same_shape(one: Size, other: Size) -> bool:
    """Return whether both may be pictures of one camera at two resolutions."""
    ratio = (one.width * other.height) / (one.height * other.width)
    return 1 / MAX_SHAPE_RATIO < ratio < MAX_SHAPE_RATIO


def text_of(size: Size) -> str:
    return f"{size.width} x {size.height}"
