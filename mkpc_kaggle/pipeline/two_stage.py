"""The Python API: two images in, matches and two-view model out."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from mkpc_kaggle.data.images import Image, ImageStore, Unreadable, read_image
from mkpc_kaggle.errors import UserError
from mkpc_kaggle.geometry.coordinates import Box, Matrix3, Pixels
from mkpc_kaggle.geometry.robust import ModelKind
from mkpc_kaggle.matchers.contract import Matcher
from mkpc_kaggle.pipeline.assembly import assemble
from mkpc_kaggle.pipeline.availability import Licence
from mkpc_kaggle.pipeline.pair import PairMatch, with_estimate
from mkpc_kaggle.progress import counted
from mkpc_kaggle.recipe import Recipe, Unit

ImageSource: TypeAlias = str | Path | Pixels | Image


class TwoStageMatcher:
    """Matcher of pairs of images::

        match = TwoStageMatcher("classical")("a.jpg", "b.jpg")
        F, points0 = match.estimate.matrix, match.inliers.points0

    or of many pairs with images in common::

        for match in matcher.match_pairs([("a.jpg", "b.jpg"), ("a.jpg", "c.jpg")]):
            print(match.estimate.inlier_count)

    ``recipe`` is a :class:`Recipe`, a recipe's name, or a path to a TOML file. ``weights`` are
    directories to search for weights. ``licence`` "permissive" refuses weights that forbid some
    uses. ``matchers`` maps names in the recipe's units to your own matchers. ``settings`` replace
    the recipe's, by dotted key, such as ``{"matchers.loftr.threshold": 0.3}``. ``progress`` counts
    the units of a call on stderr. Raises :class:`UserError` for an unknown name and for missing
    weights.
    """

    def __init__(
        self,
        recipe: Recipe | str = "auto",
        *,
        weights: Iterable[str | Path] = (),
        device: str = "auto",
        precision: str = "float32",
        licence: Licence | str = Licence.ANY,
        matchers: Mapping[str, Matcher[Any]] | None = None,
        settings: Mapping[str, Any] = MappingProxyType({}),
        progress: bool = False,
    ) -> None:
        assembly = assemble(
            recipe,
            weights=map(Path, weights),
            device=device,
            precision=precision,
            licence=Licence(licence),
            matchers=matchers,
            settings=settings,
        )
        self.recipe = assembly.recipe
        self._pipeline = assembly.pipeline()
        self._progress = progress

    def __call__(
        self,
        image0: ImageSource,
        image1: ImageSource,
        *,
        model: ModelKind | str = ModelKind.F,
        intrinsics: tuple[Matrix3, Matrix3] | None = None,
        regions: tuple[Box, Box] | None = None,
    ) -> PairMatch:
        """Match two images, given as paths or as uint8 arrays, (H, W, 3) RGB or (H, W) gray.

        ``model`` E needs ``intrinsics``, the camera matrices in pixels. ``regions`` replace MKPC's
        boxes; units of stage 2 fail if a box extends beyond its image. Points, boxes and F are in
        pixels of the stored files; EXIF only turns the matchers' views upright. If no model is
        found, ``estimate.failure`` has the reason.

        Raises ``ValueError`` for model E without intrinsics and :class:`UserError` for an
        unreadable image. Memory and device errors are not caught.
        """
        if ModelKind(model) is ModelKind.E and intrinsics is None:
            raise ValueError(
                "model E needs intrinsics=(K0, K1), the camera matrices of both images in pixels"
            )
        images = (to_image(image0), to_image(image1))
        # Set or cleared by each call: they are of this pair only.
        self._pipeline.regions = {}
        if regions:
            self._pipeline.regions = {tuple(image.name for image in images): regions}
        (pair,) = self._match(images)
        return with_estimate(pair, self.recipe, ModelKind(model), intrinsics)

    def _match(self, images: tuple[Image, Image]) -> list[PairMatch]:
        """Run all units on a pair, with a bar if the user wants one."""
        pair = PairMatch(images=images)
        units = self.recipe.units
        if not self._progress:
            return self._pipeline.match([pair], units)
        bar = counted(units, f"matching by recipe {self.recipe.name}", "unit")
        begun: set[Unit] = set()

        def may_start(unit: Unit) -> bool:
            # A unit that is tried again, in float32, counts once.
            if unit not in begun:
                begun.add(unit)
                next(bar)
            return True

        # Closed even if a unit raises: its error is printed below the bar.
        with closing(bar):
            return self._pipeline.match([pair], units, may_start)

    def match_pairs(self, pairs: Iterable[tuple[ImageSource, ImageSource]]) -> Iterator[PairMatch]:
        """Yield the match of each pair, as a call does for one pair.

        An image that appears in several pairs is decoded and encoded once, while the caches have
        room: sort the pairs by their first image. Raises :class:`UserError` for an unreadable
        image.
        """
        self._pipeline.regions = {}
        # Closed also if the caller stops early: its thread would keep the process alive.
        with closing(ImageStore()) as store:
            for first, second in pairs:
                images = (to_image(first, store), to_image(second, store))
                (pair,) = self._pipeline.match([PairMatch(images=images)], self.recipe.units)
                yield with_estimate(pair, self.recipe)


def to_image(source: ImageSource, store: ImageStore | None = None) -> Image:
    """Return the image of a path or of an array. Raise :class:`UserError` for an unreadable file.

    Paths are decoded by ``store``, if given, which remembers them.
    """
    if isinstance(source, Image):
        return source
    if isinstance(source, np.ndarray):
        return Image.of_array(source)
    path = Path(source)
    image = read_image(path) if store is None else store.get(path)
    if isinstance(image, Unreadable):
        raise UserError(str(image))
    # The name identifies the content: a file may change between calls.
    return replace(image, name=image.version)
