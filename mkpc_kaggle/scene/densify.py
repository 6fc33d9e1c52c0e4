"""Extra image pairs that densify the view graph of a batch whose images are in few pairs."""

from collections.abc import Sequence
from math import ceil
from typing import TypeAlias

MAX_IMAGES = 2000  # the search takes the square of their number

Ends: TypeAlias = tuple[int, int]  # the two images of a pair by their places, the smaller first


def extra_pairs(image_count: int, pairs: Sequence[Ends], per_image: float) -> list[Ends]:
    """The pairs that a batch lacks to have ``per_image`` pairs for each of its images, the most wanted first.

    ``pairs`` are those that it has, in any order; a call with these and the extra pairs, and a larger number, goes
    on from there. In each step the image in the fewest pairs gets a partner: the image that has most
    partners in common with it, since they are likely to show the same, and among these the one in the fewest
    pairs. Nothing for a batch of more than ``MAX_IMAGES``.
    """
    if image_count > MAX_IMAGES:
        return []
    partners: list[set[int]] = [set() for _ in range(image_count)]
    for first, second in pairs:
        partners[first].add(second)
        partners[second].add(first)
    known = {(min(ends), max(ends)) for ends in pairs}
    wanted = min(ceil(per_image * image_count), image_count * (image_count - 1) // 2)
    extra: list[Ends] = []
    while len(known) + len(extra) < wanted:
        incomplete = (image for image in range(image_count) if len(partners[image]) < image_count - 1)
        image = min(incomplete, key=lambda each: len(partners[each]))
        near = set().union(*(partners[partner] for partner in partners[image])) - partners[image] - {image}
        strangers = near or set(range(image_count)) - partners[image] - {image}
        partner = min(
            strangers, key=lambda each: (-len(partners[image] & partners[each]), len(partners[each]), each)
        )
        partners[image].add(partner)
        partners[partner].add(image)
        extra.append((min(image, partner), max(image, partner)))
    return extra
