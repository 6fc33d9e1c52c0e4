"""Pairs of a batch that nobody asked for, to be matched for its scene where its images are in few pairs."""

from collections.abc import Sequence
from math import ceil

Ends = tuple[int, int]
"""The two images of a pair, by their places, the smaller one first."""


def unasked_pairs(images: int, asked: Sequence[Ends], pairs_per_image: float) -> list[Ends]:
    """As many pairs as a batch of so many images lacks to have ``pairs_per_image``; none where it has them.

    One after the other, the image that is in the fewest pairs gets a partner: of those with which it has the most
    partners in common, since these are likely to show the same, the one that is in the fewest pairs itself.
    """
    partners: list[set[int]] = [set() for _ in range(images)]
    for first, second in asked:
        partners[first].add(second)
        partners[second].add(first)
    known = {(min(ends), max(ends)) for ends in asked}
    most = min(ceil(pairs_per_image * images), images * (images - 1) // 2)
    chosen: list[Ends] = []
    while len(known) + len(chosen) < most:
        open_images = (image for image in range(images) if len(partners[image]) < images - 1)
        image = min(open_images, key=lambda one: len(partners[one]))
        strangers = (other for other in range(images) if other != image and other not in partners[image])
        partner = min(strangers, key=lambda one: (-len(partners[image] & partners[one]), len(partners[one])))
        partners[image].add(partner)
        partners[partner].add(image)
        chosen.append((min(image, partner), max(image, partner)))
    return chosen
